"""What `protomark train` does: read, train, write the model, its card and its figures."""

from __future__ import annotations

import json
import os
import platform
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch

from protomark.acceptance import SOURCE_KEY
from protomark.calibration import calibrate
from protomark.console import console, progress_bar, progress_console
from protomark.evaluation.encode_cost import encode_nanoseconds
from protomark.evaluation.methods.bitwise import majority
from protomark.evaluation.methods.medoid import medoid
from protomark.evaluation.support import Support
from protomark.evaluation.threads import one_blas_thread
from protomark.files import write_text
from protomark.inputs import option
from protomark.tracks.file import Tracks, sequence_name
from protomark.training.card import Card, Figures, describe_data
from protomark.training.curve import save_curve, sparkline
from protomark.training.data import (
    TrainingData,
    load_training,
    load_trials,
    read_tracks,
)
from protomark.training.network import embed
from protomark.training.train import (
    Interrupted,
    Options,
    Progress,
    Trainer,
    has_fast_bfloat16,
    keep_freed_memory,
)
from protomark.training.validation import Trial, precision

if TYPE_CHECKING:
    import protomark as pm

REPORT_SEEDS = (0, 1, 2)


def train_encoder(
    training: Sequence[Path],
    validation: Sequence[Path],
    output: Path,
    options: Options,
    *,
    report: Sequence[Path] = (),
    resume: bool = False,
    inputs: str = "",
    name: str = "",
    licence: str = "",
    data_licences: Mapping[str, str] | None = None,
    device: str = "cpu",
    threads: int = 0,
    json_path: Path | None = None,
) -> Card:
    """Train an encoder and write `output`, its card beside it (.md), and `json_path`.

    A checkpoint is kept beside the output (`<output>.checkpoint`) until training is done, and a
    picture of its course (.png) for good.

    Args:
        training: tracks files to learn from.
        validation: tracks files to pick the model by.
        output: the model file to write.
        options: what decides the weights.
        report: tracks files on which the finished encoder is measured, and nothing else.
        resume: continue from the checkpoint.
        inputs: of keypoints that are added to the descriptors, see `protomark.inputs`.
        name: of the encoder; the output's stem if empty.
        licence: of the weights.
        data_licences: of the sequences, by name, for the card and the model file.
        device: "cpu" or "cuda".
        threads: for PyTorch on a CPU; 0 for one a core.
        json_path: where the figures go as JSON.

    Raises:
        FileNotFoundError: a tracks file, the output's folder, or the checkpoint is missing.
        ValueError: tracks, outputs, options, device or checkpoint do not fit.
        Interrupted: Ctrl-C; `resume` continues.
    """
    import protomark as pm

    options.check()
    _check_device(device)
    _check_outputs(output, json_path)
    keep_freed_memory()
    threads = threads or os.cpu_count() or 1
    torch.set_num_threads(threads)
    for path in report:
        if not path.is_file():
            raise FileNotFoundError(f"{path}: no such tracks file")
    data = load_training(training, validation, licences=data_licences, inputs=inputs)
    for path in report:
        _check_report(path, data, inputs)
    half = has_fast_bfloat16(device)
    checkpoint = output.with_name(output.name + ".checkpoint")
    trainer = Trainer(data.views, data.trials, options, checkpoint, data.fingerprint, device, half)
    if resume:
        trainer.resume()
    card_path, curve = _beside(output)
    _run(trainer, curve, name or output.stem)

    encoder = pm.Encoder(
        [{**layer} for layer in trainer.quantized.export()],
        dims=list(options.dims),
        name=name or output.stem,
        descriptor=data.descriptor,
        scale=float(trainer.quantized.scale),
        data=describe_data(data.sources),
        licence=licence,
    )
    encoder, calibrated_on = _calibrated(encoder, [*training, *validation], threads)
    encoder.save(output)
    figures = []
    with progress_bar() as bar:
        files = [(p, "validation") for p in validation] + [(p, "report") for p in report]
        task = bar.add_task("measuring", total=len(files))
        for path, role in files:
            figures.append(_measure(trainer, encoder, path, role, inputs, device, threads))
            bar.advance(task)
    card = Card(
        name=encoder.name,
        descriptor=data.descriptor,
        bits=data.bits,
        widths=[data.bits, *trainer.network.hidden, options.dims[-1]],
        dims=list(options.dims),
        bytes=output.stat().st_size,
        encode_ns=encode_nanoseconds(encoder),
        licence=licence,
        sources=data.sources,
        validation=data.validation_sources,
        command=_command(
            data,
            report,
            output,
            options,
            inputs,
            name,
            licence,
            data_licences,
            device,
        ),
        seconds=trainer.seconds,
        machine=_machine(device, threads, half),
        steps=options.steps,
        best_step=trainer.best_step,
        figures=figures,
        history=[(p.step, p.loss, p.mean_precision) for p in trainer.history],
        curve=curve.name,
        calibrated_on=calibrated_on,
    )
    write_text(card_path, card.markdown())
    if json_path is not None:
        write_text(json_path, json.dumps(asdict(card), indent=1) + "\n")
    checkpoint.unlink(missing_ok=True)
    return card


def _calibrated(encoder: pm.Encoder, paths: Sequence[Path], threads: int) -> tuple[pm.Encoder, str]:
    """The encoder with what to accept, fitted to those files that have no varied copies.

    Tracks that leave nothing to fit end no training: the encoder then says nothing.
    """
    plain = [path for path in paths if not Tracks.load(path).info.get("variants")]
    try:
        with one_blas_thread():  # more add up in another order
            encoder, _ = calibrate(encoder, plain, threads)
    except ValueError as error:
        progress_console.print(
            f"not calibrated, so that `protomark localize` will not know which matches to accept: "
            f"{error}",
            markup=False,
            highlight=False,
            soft_wrap=True,
        )
    return encoder, encoder.notes.get(SOURCE_KEY, "")


def default_output(tracks: Path, resume: bool = False, inputs: str = "") -> Path:
    """`<descriptor>.pme` in the working directory, for the descriptor of a tracks file.

    Raises:
        FileExistsError: it, its card or its picture is there already, and would be overwritten.
    """
    output = Path(f"{read_tracks(tracks, inputs).descriptor}.pme")
    for path in (output, *_beside(output)):
        if path.exists() and not resume:
            raise FileExistsError(f"{path} exists and is kept; name another file with -o")
    return output


def _beside(output: Path) -> tuple[Path, Path]:
    """The card and the picture of a model file."""
    return output.with_suffix(".md"), output.with_suffix(".png")


def _check_outputs(output: Path, json_path: Path | None) -> None:
    """Raise before the first step if a result could not be written after the last."""
    beside = _beside(output)
    if output in beside:
        raise ValueError(
            f"{output}: {output.suffix} is the ending of what is written beside the model; name "
            "the model .pme"
        )
    for path in (output, *beside, json_path):
        if path is None:
            continue
        if path.is_dir():
            raise ValueError(f"{path} is a folder; name a file to write")
        if not path.absolute().parent.is_dir():
            raise FileNotFoundError(f"{path}: the folder {path.absolute().parent} does not exist")


def _check_report(path: Path, data: TrainingData, inputs: str) -> None:
    """Raise before the first step if the encoder could not be measured on these tracks."""
    tracks = read_tracks(path, inputs)
    if (tracks.descriptor, tracks.bits) != (data.descriptor, data.bits):
        raise ValueError(
            f"{path}: {tracks.descriptor} descriptors of {tracks.bits} bits, but the encoder is "
            f"for {data.descriptor} of {data.bits}; report on tracks of the same descriptor"
        )
    load_trials(tracks, path, REPORT_SEEDS)


def _run(trainer: Trainer, curve: Path, name: str) -> None:
    """Train behind a progress bar; each validation leaves a line and draws `curve` anew."""
    losses: list[float] = []
    with progress_bar() as bar:
        task = bar.add_task("training", total=trainer.options.steps, completed=trainer.step)
        mean = 0.0

        def step(done: int, loss: float, progress: Progress | None) -> None:
            nonlocal mean
            mean = 0.98 * mean + 0.02 * loss if mean else loss
            if done % 20 == 0:
                losses.append(mean)
            found = [p.mean_precision for p in trainer.history]
            text = f"loss {mean:.3f} {sparkline(losses, 12)}"
            if found:
                text += f" precision {found[-1]:.3f} {sparkline(found, 8)}"
            bar.update(task, completed=done, description=text)
            if progress is not None:
                bar.console.print(_line(progress), highlight=False)
                save_curve(trainer.history, curve, name)

        trainer.run(step)


def _line(p: Progress) -> str:
    found = "  ".join(f"{d}: {value:.4f}" for d, value in p.precision.items())
    stage = "quantised" if p.quantized else "float"
    return f"step {p.step:6d}  loss {p.loss:.4f}  precision {found}  ({stage}, {p.seconds:.0f} s)"


def _measure(
    trainer: Trainer,
    encoder: pm.Encoder,
    path: Path,
    role: str,
    inputs: str,
    device: str,
    threads: int,
) -> Figures:
    dims = trainer.options.dims
    trials = load_trials(read_tracks(path, inputs), path, REPORT_SEEDS)
    plain = load_trials(Tracks.load(path), path, REPORT_SEEDS) if inputs else trials
    floats = [precision(t, lambda d: embed(trainer.network, d, device), dims) for t in trials]
    whole = [precision(t, lambda d: encoder.encode(d, threads=threads), dims) for t in trials]
    binary = [
        _binary_precision(t, seed, threads) for t, seed in zip(plain, REPORT_SEEDS, strict=True)
    ]
    return Figures(
        sequence_name(path),
        role,
        len(trials),
        float(np.mean([unaggregated_precision(t, threads) for t in plain])),
        float(np.mean([b["medoid"] for b in binary])),
        float(np.mean([b["majority"] for b in binary])),
        {d: float(np.mean([p[d] for p in floats])) for d in dims},
        {d: float(np.mean([p[d] for p in whole])) for d in dims},
    )


def _binary_precision(trial: Trial, seed: int, threads: int) -> dict[str, float]:
    """Precision of maps with one binary descriptor a landmark."""
    support = Support(trial.landmarks, trial.support, seed)
    found = {}
    for name, method in (("medoid", medoid(support)), ("majority", majority(support))):
        nearest, _ = method.match(trial.queries, threads=threads)
        found[name] = float((nearest[:, 0] == trial.targets).mean())
    return found


def unaggregated_precision(trial: Trial, threads: int = 1) -> float:
    """Share of queries whose nearest raw descriptor is one of their own landmark's."""
    import protomark as pm

    found, _ = pm.hamming_search(trial.queries, trial.support, k=1, threads=threads)
    return float((trial.landmarks[found[:, 0]] == trial.targets).mean())


def _check_device(device: str) -> None:
    if device != "cpu" and not device.startswith("cuda"):
        raise ValueError(f"device {device!r} is not known; give cpu or cuda")
    if device.startswith("cuda") and not torch.cuda.is_available():
        raise ValueError("no CUDA device that this PyTorch can use; train with --device cpu")


def _command(
    data: TrainingData,
    report: Sequence[Path],
    output: Path,
    options: Options,
    inputs: str,
    name: str,
    licence: str,
    data_licences: Mapping[str, str] | None,
    device: str,
) -> str:
    """The command that trains this encoder again, files by name only."""
    words = ["protomark", "train", *(s.file for s in data.sources)]
    for source in data.validation_sources:
        words += ["--validation", source.file]
    for path in report:
        words += ["--report", path.name]
    words += ["-o", output.name]
    if inputs:
        words.append(option(inputs))
    default = Options()
    if options.dims != default.dims:
        words += ["--dims", ",".join(map(str, options.dims))]
    for flag, field in _FLAGS.items():
        if getattr(options, field) != getattr(default, field):
            words += [flag, str(getattr(options, field))]
    for flag, value in (("--name", name), ("--licence", licence)):
        if value:
            words += [flag, value]
    for source in [*data.sources, *data.validation_sources]:
        if data_licences and source.name in data_licences:
            words += ["--data-licence", f"{source.name}={source.licence}"]
    if device != "cpu":
        words += ["--device", device]
    return shlex.join(words)


_FLAGS = {"--steps": "steps", "--batch": "landmarks", "--seed": "seed"}


def _machine(device: str, threads: int, half: bool) -> str:
    arithmetic = "bfloat16" if half else "float32"
    if device.startswith("cuda"):
        return f"{torch.cuda.get_device_name(device)}, {arithmetic}"
    return f"{platform.machine()}, {threads} thread{'s' if threads != 1 else ''}, {arithmetic}"


def print_summary(card: Card, output: Path) -> None:
    """The result of a training, on stdout."""
    from rich.table import Table

    table = Table("sequence", "unaggregated", "dim", "bytes", "float", "integer", "ratio")
    for f in card.figures:
        for d in card.dims:
            table.add_row(
                f"{f.sequence} ({f.role})",
                f"{f.unaggregated:.4f}",
                str(d),
                str(d + 1),
                f"{f.float_precision[d]:.4f}",
                f"{f.integer_precision[d]:.4f}",
                f"{f.integer_precision[d] / max(f.unaggregated, 1e-9):.3f}",
            )
    console.print(table)
    card_path, curve = _beside(output)
    console.print(
        f"{output} ({card.bytes:,} bytes), {card_path} and {curve}",
        markup=False,
        highlight=False,
        soft_wrap=True,
    )


def explain_interruption(stop: Interrupted, output: Path) -> None:
    """What to do after Ctrl-C, on stderr."""
    progress_console.print(
        f"{stop}; the same command with --resume continues ({output.name}.checkpoint)",
        markup=False,
        highlight=False,
        soft_wrap=True,
    )
