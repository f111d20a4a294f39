"""Trains the weights of the integer encoder on batches of landmarks.

The first steps train the float network; then quantisation enters the loop. Every `validate_every`
steps the precision on validation tracks is measured and a checkpoint is written; the result is the
quantised network with the best precision.
"""

from __future__ import annotations

import ctypes
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from protomark.files import replacing
from protomark.interrupt import Interrupted, deferred_interrupt
from protomark.training.loss import PrototypeLoss
from protomark.training.network import EncoderNetwork, InputScaling, embed
from protomark.training.quantization import QuantizedNetwork
from protomark.training.sampling import BatchSampler, Views
from protomark.training.validation import Trial, mean_precision

CHECKPOINT_VERSION = 2
# What a checkpoint keeps of a trainer, beside weights, optimizer and history.
_PROGRESS = ("step", "seconds", "best", "best_step", "best_state", "_losses")


@dataclass(frozen=True)
class TrainingOptions:
    """Options that determine the weights, besides the data."""

    # Ascending prefixes that are trained to work alone; the last is the full length.
    dims: tuple[int, ...] = (8, 16, 24, 32, 48, 64)
    hidden: tuple[int, ...] | None = None  # widths of the hidden layers; None: `default_hidden`
    steps: int = 4000  # number of batches
    landmarks: int = 1000  # landmarks per batch
    views: int = 9  # limit on views per landmark in a batch
    queries: int = 3  # limit on queries per landmark in a batch
    balance: float = 0.5  # see `BatchSampler`
    noise: float = 0.03  # share of bits that are flipped, or see `sampling.with_noise`
    # Peak rate of AdamW after a warm-up, from which it falls as a cosine.
    learning_rate: float = 5e-3
    weight_decay: float = 0.1  # weight decay of AdamW
    clip: float = 1.0  # largest norm of the gradient
    # Share of the steps, the last ones, with quantisation in the loop.
    quantized_share: float = 0.25
    validate_every: int = 500  # steps between validations and checkpoints
    seed: int = 0  # seed of weights and batches

    def check(self) -> None:
        """Raise ValueError if an option is invalid."""
        if not self.dims or list(self.dims) != sorted(set(self.dims)) or self.dims[0] < 1:
            raise ValueError(f"dims {self.dims} must be positive and ascending, as in 8,16,32")
        if self.dims[-1] > 255:
            raise ValueError(f"dims {self.dims}: a code has at most 255 numbers")
        # A batch tells landmarks apart, and a query needs two views in its support.
        least = {"steps": 1, "landmarks": 2, "views": 3, "queries": 1, "validate_every": 1}
        for name, limit in least.items():
            if getattr(self, name) < limit:
                raise ValueError(f"{name} is {getattr(self, name)}, it must be at least {limit}")

    @property
    def quantized_from(self) -> int:
        """First step with quantisation in the loop."""
        return self.steps - max(round(self.steps * self.quantized_share), 1)

    def trained_dims(self, step: int) -> tuple[int, ...]:
        """The prefixes in the loss of a step: of more than three, every other one in turn.

        For each prefix the loss costs as much as the network, and neighbours train each other.
        """
        if len(self.dims) <= 3:
            return self.dims
        return tuple(d for i, d in enumerate(reversed(self.dims)) if (i + step) % 2 == 0)

    def rate(self, step: int) -> float:
        """Learning rate of a step."""
        warm_up = max(min(200, self.steps // 10), 1)
        if step < warm_up:
            return self.learning_rate * (step + 1) / warm_up
        done = (step - warm_up) / max(self.steps - warm_up, 1)
        return self.learning_rate * (0.01 + 0.99 * (1 + math.cos(math.pi * done)) / 2)


@dataclass(frozen=True)
class ValidationStep:
    """The result of a validation."""

    step: int  # number of finished steps
    loss: float  # mean training loss since the last validation
    precision: dict[int, float]  # precision by code length, of the network in the loop
    quantized: bool  # whether quantisation is in the loop
    seconds: float  # training time so far, over all runs

    @property
    def mean_precision(self) -> float:
        """Mean precision over code lengths, which selects the model."""
        return sum(self.precision.values()) / len(self.precision)


@dataclass
class Trainer:
    """Trains one encoder."""

    sequences: Sequence[Views]  # training sequences, see `data.load_training`
    trials: Sequence[Trial]  # validation splits
    options: TrainingOptions
    checkpoint: Path | None = None  # file of the checkpoint, None for none
    fingerprint: str = ""  # digest of the data, so that no checkpoint is resumed with other data
    device: str = "cpu"  # "cpu" or "cuda"
    half: bool = False  # whether matrix products run in bfloat16

    def __post_init__(self) -> None:
        options, sequences = self.options, self.sequences
        options.check()
        self.sampler = BatchSampler(
            sequences,
            options.landmarks,
            options.views,
            options.queries,
            options.balance,
            options.noise,
        )
        torch.manual_seed(options.seed)
        part = max(4096 // len(sequences), 1)
        self._calibration = np.concatenate(
            [s.descriptors[:: max(len(s.descriptors) // part, 1)][:part] for s in sequences]
        )
        kind, width = sequences[0].kind, self._calibration.shape[1]
        self.network = EncoderNetwork(
            8 * width if kind == "bits" else width,
            options.dims[-1],
            options.hidden,
            InputScaling.fit(kind, self._calibration),
        ).to(self.device)
        self.quantized = QuantizedNetwork(self.network)
        self.loss = PrototypeLoss(options.dims).to(self.device)
        self.optimizer = torch.optim.AdamW(
            [
                {"params": self.network.parameters(), "weight_decay": options.weight_decay},
                {"params": self.loss.parameters(), "weight_decay": 0.0},
            ],
            lr=options.learning_rate,
        )
        self.step = 0
        self.seconds = 0.0
        self.history: list[ValidationStep] = []
        self.best = -1.0
        self.best_step = 0
        self.best_state: dict[str, Tensor] = {}
        self._losses: list[float] = []

    def run(self, report: Callable[[int, float, ValidationStep | None], None]) -> None:
        """Train to the end; then `quantized` holds the best model.

        `report` gets the number of finished steps, the loss, and the validation, if there was one.
        """
        options = self.options
        self.network.train()
        started = time.perf_counter() - self.seconds
        with deferred_interrupt() as interrupted:
            while self.step < options.steps:
                if self.step == options.quantized_from:
                    self.calibrate()
                loss = self._train_step()
                self.step += 1
                self.seconds = time.perf_counter() - started
                progress = None
                if self.step % options.validate_every == 0 or self.step == options.steps:
                    progress = self._validate()
                    self.save_checkpoint()
                report(self.step, loss, progress)
                if interrupted() and self.step < options.steps:
                    self.save_checkpoint()
                    raise Interrupted(
                        f"stopped after step {self.step}; the same command with --resume "
                        f"continues ({self.checkpoint})"
                    )
        self.quantized.load_state_dict(self.best_state)

    def _train_step(self) -> float:
        options = self.options
        # Each step has a generator of its own, so that resuming needs no generator state.
        batch = self.sampler.sample(np.random.default_rng([options.seed, self.step]))
        for group in self.optimizer.param_groups:
            group["lr"] = options.rate(self.step)
        model = self.quantized if self.step >= options.quantized_from else self.network
        inputs = self.network.scaling.inputs(batch.descriptors, self.device)
        with torch.autocast(torch.device(self.device).type, torch.bfloat16, enabled=self.half):
            embeddings = model(inputs)
        loss = self.loss(
            embeddings,
            torch.from_numpy(batch.landmarks).to(self.device),
            torch.from_numpy(batch.queries).to(self.device),
            options.trained_dims(self.step),
        )
        self.optimizer.zero_grad(set_to_none=True)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(self.network.parameters(), options.clip)
        value = float(loss.detach())
        if not math.isfinite(value):
            raise ValueError(
                f"the loss is {value} at step {self.step}: train with a smaller learning rate"
            )
        self.optimizer.step()
        self._losses.append(value)
        return value

    def calibrate(self) -> None:
        """Set the ranges of `quantized` by descriptors of all training sequences."""
        self.quantized.calibrate(self.network.scaling.inputs(self._calibration, self.device))

    def _validate(self) -> ValidationStep:
        in_loop = self.step > self.options.quantized_from
        model = self.quantized if in_loop else self.network
        found = mean_precision(
            self.trials, lambda d: embed(model, d, self.device), self.options.dims
        )
        progress = ValidationStep(
            self.step,
            float(np.mean(self._losses)),
            found,
            in_loop,
            self.seconds,
        )
        self.history.append(progress)
        self._losses = []
        if in_loop and progress.mean_precision > self.best:
            self.best = progress.mean_precision
            self.best_step = self.step
            self.best_state = {k: v.clone() for k, v in self.quantized.state_dict().items()}
        return progress

    def save_checkpoint(self) -> None:
        """Write the checkpoint atomically."""
        if self.checkpoint is None:
            return
        state = {
            "version": CHECKPOINT_VERSION,
            "options": asdict(self.options),
            "fingerprint": self.fingerprint,
            "progress": {name: getattr(self, name) for name in _PROGRESS},
            "model": self.quantized.state_dict(),
            "loss": self.loss.state_dict(),
            "optimizer": self.optimizer.state_dict(),
            "history": [asdict(p) for p in self.history],
        }
        with replacing(self.checkpoint) as file:
            torch.save(state, file)

    def resume(self) -> None:
        """Continue from the checkpoint."""
        path = self.checkpoint
        if path is None or not path.is_file():
            raise FileNotFoundError(f"{path}: no checkpoint to resume, train without --resume")
        try:
            state: dict[str, Any] = torch.load(path, map_location=self.device, weights_only=True)
        except Exception as error:
            raise ValueError(
                f"{path}: not a checkpoint, or a broken one: delete it and train anew"
            ) from error
        if state.get("version") != CHECKPOINT_VERSION:
            raise ValueError(f"{path}: checkpoint of another version: delete it and train anew")
        if state["fingerprint"] != self.fingerprint:
            raise ValueError(
                f"{path}: checkpoint of other tracks: give the same ones, or train without --resume"
            )
        for name, value in asdict(self.options).items():
            if state["options"].get(name) != value:
                raise ValueError(
                    f"{path}: the checkpoint was made with {name} {state['options'].get(name)}, "
                    f"not {value}: give the same, or train without --resume"
                )
        for name in _PROGRESS:
            setattr(self, name, state["progress"][name])
        self.quantized.load_state_dict(state["model"])
        self.loss.load_state_dict(state["loss"])
        self.optimizer.load_state_dict(state["optimizer"])
        self.history = [ValidationStep(**p) for p in state["history"]]


def keep_freed_memory() -> None:
    """Make glibc retain large freed blocks instead of returning them to the system.

    Each step allocates the same large matrices, and allocating their pages anew takes up to half of
    a step on a CPU. With another C library this does nothing.
    """
    m_trim_threshold, m_mmap_max = -1, -4
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (OSError, AttributeError, TypeError):
        return
    mallopt(m_mmap_max, 0)
    mallopt(m_trim_threshold, 1 << 30)


def has_fast_bfloat16(device: str) -> bool:
    """Whether bfloat16 matrix products are faster than float32 on this machine."""
    if device.startswith("cuda"):
        return bool(torch.cuda.is_bf16_supported())
    supported = getattr(torch.cpu, "_is_avx512_bf16_supported", None)
    return bool(supported and supported())
