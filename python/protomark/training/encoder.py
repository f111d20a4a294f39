"""Trains an encoder from tracks files, and writes the model and its card."""

from __future__ import annotations

import platform
import shlex
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch

import protomark as pm
from protomark.baselines import binary
from protomark.baselines.support import Support
from protomark.files import check_outputs, write_text
from protomark.match_calibration import SOURCE_KEY
from protomark.plot import save_figure, training_figure
from protomark.progress import Progress, silent
from protomark.threads import one_blas_thread
from protomark.tracks.file import Tracks, sequence_name
from protomark.training.card import EncoderCard, SequencePrecision, describe_data
from protomark.training.codebooks import with_codebooks
from protomark.training.data import (
    REPORT_SEEDS,
    TrainingData,
    load_training,
    load_trials,
    read_tracks,
)
from protomark.training.match_calibration import calibrate
from protomark.training.network import embed
from protomark.training.train import (
    Trainer,
    TrainingOptions,
    ValidationStep,
    has_fast_bfloat16,
    keep_freed_memory,
)
from protomark.training.validation import Trial, mean_precision


@dataclass(frozen=True)
class TrainingRequest:
    """What to train an encoder from, and what to write."""

    training: Sequence[Path]  # tracks files to train on
    validation: Sequence[Path]  # tracks files that select the model
    # The model file to write; its card (.md) and a picture of the training (.png) are written
    # beside it, and a checkpoint (`<output>.checkpoint`) until training ends.
    output: Path
    options: TrainingOptions  # options that determine the weights
    report: Sequence[Path] = ()  # further tracks files to measure the encoder on
    resume: bool = False  # whether to continue from the checkpoint
    upright: bool = False  # whether to train on angles and sizes of keypoints, too
    name: str = ""  # name of the encoder; if empty, the output's stem
    licence: str = ""  # licence of the weights
    # Licences of the sequences by name, for the card and the model file.
    data_licences: Mapping[str, str] = field(default_factory=dict)
    device: str = "cpu"  # "cpu" or "cuda"
    threads: int = 1

    @property
    def card_path(self) -> Path:
        """The card beside the model."""
        return self.output.with_suffix(".md")

    @property
    def plot_path(self) -> Path:
        """The picture of the training beside the model."""
        return self.output.with_suffix(".png")

    def check(self) -> None:
        """Raise before the first step if a result could not be written after the last."""
        self.options.check()
        if self.device != "cpu" and not self.device.startswith("cuda"):
            raise ValueError(f"device {self.device!r} is unknown: give cpu or cuda")
        if self.device.startswith("cuda") and not torch.cuda.is_available():
            raise ValueError("this PyTorch finds no CUDA device: train with --device cpu")
        if self.output in (self.card_path, self.plot_path):
            raise ValueError(
                f"{self.output}: {self.output.suffix} is the suffix of a file that is written "
                "beside the model: name the model .pme"
            )
        inputs = (*self.training, *self.validation, *self.report)
        check_outputs(self.output, self.card_path, self.plot_path, inputs=inputs)

    def command(self, data: TrainingData) -> str:
        """The command that trains this encoder again, with file names instead of paths."""
        words = ["protomark", "train", *(s.file for s in data.sources)]
        for source in data.validation_sources:
            words += ["--validation", source.file]
        for path in self.report:
            words += ["--report", path.name]
        words += ["-o", self.output.name]
        if self.upright:
            words.append("--upright")
        default = TrainingOptions()
        if self.options.dims != default.dims:
            words += ["--dims", ",".join(map(str, self.options.dims))]
        for flag, name in (("--steps", "steps"), ("--batch", "landmarks"), ("--seed", "seed")):
            if getattr(self.options, name) != getattr(default, name):
                words += [flag, str(getattr(self.options, name))]
        for flag, value in (("--name", self.name), ("--licence", self.licence)):
            if value:
                words += [flag, value]
        for source in [*data.sources, *data.validation_sources]:
            if source.name in self.data_licences:
                words += ["--data-licence", f"{source.name}={source.licence}"]
        if self.device != "cpu":
            words += ["--device", self.device]
        return shlex.join(words)


def train_encoder(
    request: TrainingRequest,  # what to train from, and what to write
    progress: Progress = silent,
    # Called with a line per validation, and with warnings.
    note: Callable[[str], None] = lambda line: None,
) -> EncoderCard:
    """Train an encoder, write it with its card and a picture, and measure it."""
    request.check()
    keep_freed_memory()
    threads = request.threads
    torch.set_num_threads(threads)
    data = load_training(
        request.training,
        request.validation,
        licences=request.data_licences,
        upright=request.upright,
        report=request.report,
        progress=progress,
    )
    half = has_fast_bfloat16(request.device)
    checkpoint = request.output.with_name(request.output.name + ".checkpoint")
    trainer = Trainer(
        data.views,
        data.trials,
        request.options,
        checkpoint,
        data.fingerprint,
        request.device,
        half,
    )
    if request.resume:
        trainer.resume()
    name = request.name or request.output.stem
    _run(trainer, request.plot_path, name, progress, note)
    encoder = pm.Encoder(
        [{**layer} for layer in trainer.quantized.export()],
        dims=list(request.options.dims),
        name=name,
        descriptor=data.descriptor,
        input=trainer.network.scaling.kind,
        input_scale=trainer.network.scaling.scale,
        scale=float(trainer.quantized.scale),
        data=describe_data(data.sources),
        licence=request.licence,
    )
    encoder = with_codebooks(encoder, data.views, progress)
    encoder, calibrated_on = _calibrated(
        encoder, [*request.training, *request.validation], threads, note
    )
    encoder.save(request.output)
    files = [(p, "validation") for p in request.validation]
    files += [(p, "report") for p in request.report]
    figures = []
    for done, (path, role) in enumerate(files):
        progress("measure", done, len(files))
        figures.append(_measure(trainer, encoder, path, role, request, threads))
    card = EncoderCard(
        name=name,
        descriptor=data.descriptor,
        bits=data.bits,
        input=trainer.network.scaling.kind,
        widths=trainer.network.widths,
        dims=list(request.options.dims),
        bytes=request.output.stat().st_size,
        licence=request.licence,
        sources=data.sources,
        validation=data.validation_sources,
        command=request.command(data),
        seconds=trainer.seconds,
        machine=_machine(request.device, threads, half),
        steps=request.options.steps,
        best_step=trainer.best_step,
        figures=figures,
        history=[(v.step, v.loss, v.mean_precision) for v in trainer.history],
        plot=request.plot_path.name,
        calibrated_on=calibrated_on,
    )
    write_text(request.card_path, card.markdown())
    checkpoint.unlink(missing_ok=True)
    return card


def default_output(tracks: Path, resume: bool = False, upright: bool = False) -> Path:
    """`<descriptor>.pme` in the working directory, for the descriptor of a tracks file."""
    output = Path(f"{read_tracks(tracks, upright).descriptor}.pme")
    for path in (output, output.with_suffix(".md"), output.with_suffix(".png")):
        if path.exists() and not resume:
            raise FileExistsError(f"{path} exists already: name another file with -o")
    return output


def _run(
    trainer: Trainer, plot: Path, name: str, progress: Progress, note: Callable[[str], None]
) -> None:
    mean = 0.0

    def step(done: int, loss: float, validation: ValidationStep | None) -> None:
        nonlocal mean
        mean = 0.98 * mean + 0.02 * loss if mean else loss
        figures = f"loss {mean:.3f}"
        if trainer.history:
            figures += f", precision {trainer.history[-1].mean_precision:.3f}"
        progress(f"train, {figures}", done, trainer.options.steps)
        if validation is not None:
            note(_line(validation))
            _save_plot(trainer.history, plot, name)

    trainer.run(step)


def _line(v: ValidationStep) -> str:
    precisions = "  ".join(f"{d}: {value:.4f}" for d, value in v.precision.items())
    stage = "quantised" if v.quantized else "float"
    return (
        f"step {v.step:6d}  loss {v.loss:.4f}  precision {precisions}  ({stage}, {v.seconds:.0f} s)"
    )


def _save_plot(history: Sequence[ValidationStep], path: Path, name: str) -> None:
    figure = training_figure(
        [v.step for v in history],
        [v.loss for v in history],
        {d: [v.precision[d] for v in history] for d in history[-1].precision},
        next((v.step for v in history if v.quantized), None),
        name,
    )
    save_figure(figure, path, made_by="protomark train", dpi=120)


def _calibrated(
    encoder: pm.Encoder, paths: Sequence[Path], threads: int, note: Callable[[str], None]
) -> tuple[pm.Encoder, str]:
    """The encoder with a match calibration that is fitted to the plain tracks, and its data.

    If the tracks allow no fit, the training goes on, and the encoder has no calibration.
    """
    plain = [path for path in paths if not Tracks.load(path).info.get("augmentations")]
    try:
        with one_blas_thread():  # more threads would change the order of sums
            encoder, _ = calibrate(encoder, plain, threads)
    except ValueError as error:
        note(f"the encoder is not calibrated, so `protomark localize` cannot use it: {error}")
    return encoder, encoder.notes.get(SOURCE_KEY, "")


def _measure(
    trainer: Trainer,
    encoder: pm.Encoder,
    path: Path,
    role: str,
    request: TrainingRequest,
    threads: int,
) -> SequencePrecision:
    dims = trainer.options.dims
    device = request.device
    trials = load_trials(read_tracks(path, request.upright), path, REPORT_SEEDS)
    plain = load_trials(Tracks.load(path), path, REPORT_SEEDS) if request.upright else trials
    shares = np.mean([binary_precision(t, threads) for t in plain], axis=0)
    unaggregated, medoid, majority = shares.tolist()
    return SequencePrecision(
        sequence_name(path),
        role,
        len(trials),
        unaggregated,
        medoid,
        majority,
        mean_precision(trials, lambda d: embed(trainer.network, d, device), dims),
        mean_precision(trials, lambda d: encoder.encode(d, threads=threads), dims),
    )


def binary_precision(trial: Trial, threads: int = 1) -> list[float]:
    """Precision of all raw descriptors, of medoids and of majorities, one each per landmark."""
    support = Support(trial.landmarks, trial.support, kind=trial.kind)
    shares = []
    for method in (binary.unaggregated, binary.medoid, binary.majority):
        nearest, _ = method(support).match(trial.queries, threads=threads)
        shares.append(float((nearest[:, 0] == trial.targets).mean()))
    return shares


def _machine(device: str, threads: int, half: bool) -> str:
    arithmetic = "bfloat16" if half else "float32"
    if device.startswith("cuda"):
        return f"{torch.cuda.get_device_name(device)}, {arithmetic}"
    return f"{platform.machine()}, {threads} thread{'s' if threads != 1 else ''}, {arithmetic}"
