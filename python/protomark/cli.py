"""The `protomark` command."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

app = typer.Typer(
    help="One small integer prototype per landmark instead of all its binary descriptors.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)


@app.command()
def tracks(
    folders: Annotated[
        list[Path],
        typer.Argument(
            metavar="FOLDER",
            help="Sequences: each holds images/ and a COLMAP model in sparse/ or sparse/0/.",
        ),
    ],
    output: Annotated[
        Path,
        typer.Option("--output", "-o", help="Folder for the files FOLDER.DESCRIPTOR.safetensors."),
    ],
    descriptors: Annotated[
        list[str] | None,
        typer.Option(
            "--descriptor",
            "-d",
            help="freak, orb, brisk, akaze, latch, beblid or teblid; may be repeated.",
            show_default="freak",
        ),
    ] = None,
    images: Annotated[
        Path | None, typer.Option("--images", help="Folder of the images, if not FOLDER/images.")
    ] = None,
    model: Annotated[
        Path | None, typer.Option("--model", help="Folder of the COLMAP model, text or binary.")
    ] = None,
    database: Annotated[
        Path | None,
        typer.Option(
            "--database",
            help="COLMAP database that already holds binary descriptors: they and the model's "
            "points become the tracks, images are not read.",
        ),
    ] = None,
    max_keypoints: Annotated[
        int, typer.Option(help="Keypoints kept in an image, strongest first, spread over it.")
    ] = 2000,
    partners: Annotated[
        int, typer.Option(help="About how many keyframes each keyframe is matched with.")
    ] = 24,
    ratio: Annotated[float, typer.Option(help="Ratio test of matching, in (0, 1].")] = 0.8,
    max_error: Annotated[
        float, typer.Option(help="Largest epipolar and reprojection error, pixels.")
    ] = 3.0,
    min_angle: Annotated[
        float, typer.Option(help="Smallest angle between two rays of a landmark, degrees.")
    ] = 1.0,
    min_length: Annotated[int, typer.Option(help="Fewest observations of a landmark.")] = 3,
    refine_poses: Annotated[
        str,
        typer.Option(
            help="yes, no, or auto: bundle adjustment where the matches say that the given poses "
            "are only roughly right."
        ),
    ] = "auto",
    max_unlabelled: Annotated[
        int | None,
        typer.Option(
            help="Keypoints without a landmark kept in a keyframe, the strongest (smaller files)."
        ),
    ] = None,
    variants: Annotated[
        int,
        typer.Option(
            help="Also write FOLDER.DESCRIPTOR.varied.safetensors, to train on: with this many "
            "copies of each image, warped and with other light, blur and noise."
        ),
    ] = 0,
    threads: Annotated[
        int, typer.Option(help="CPU threads, 0 for one a core; the result is the same.")
    ] = 0,
    force: Annotated[
        bool, typer.Option("--force", help="Make files anew that are there and up to date.")
    ] = False,
    json_file: Annotated[
        Path | None, typer.Option("--json", help="Write the figures to this file.")
    ] = None,
) -> None:
    """Make tracks from images with known poses: keypoints, descriptors and their landmarks.

    A file that is there already is kept if it was made with these options from this input.
    """
    import os

    from protomark.tracks.command import make_tracks
    from protomark.tracks.extract import Settings

    settings = [
        Settings(
            descriptor=name,
            max_keypoints=max_keypoints,
            partners=partners,
            ratio=ratio,
            max_error=max_error,
            min_angle=min_angle,
            min_length=min_length,
            refine_poses=refine_poses,
            max_unlabelled=max_unlabelled,
        )
        for name in dict.fromkeys(descriptors or ["freak"])
    ]
    make_tracks(
        folders,
        settings,
        output,
        images=images,
        model=model,
        database=database,
        variants=variants,
        force=force,
        threads=threads if threads > 0 else os.cpu_count() or 1,
        json_path=json_file,
    )


@app.command()
def train(
    tracks: Annotated[
        list[Path], typer.Argument(help="Tracks files to learn from, one a sequence.")
    ],
    validation: Annotated[
        list[Path] | None,
        typer.Option(
            "--validation",
            help="Tracks file that picks the model; may be repeated. By default the last of TRACKS "
            "is not learned from but picks.",
        ),
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option(
            "--output", "-o", help="Model file to write; by default DESCRIPTOR.pme, if not there."
        ),
    ] = None,
    report: Annotated[
        list[Path] | None,
        typer.Option("--report", help="Tracks file to measure the result on; may be repeated."),
    ] = None,
    dims: Annotated[
        str, typer.Option(help="Code lengths that shall serve, ascending.")
    ] = "8,16,24,32,48,64",
    steps: Annotated[int, typer.Option(help="Batches in all.")] = 4000,
    batch: Annotated[int, typer.Option(help="Landmarks in a batch.")] = 1000,
    seed: Annotated[int, typer.Option(help="Of weights and batches.")] = 0,
    upright: Annotated[
        bool,
        typer.Option(
            "--upright", help="For cameras that do not roll: learn from angles and sizes, too."
        ),
    ] = False,
    sized: Annotated[
        bool,
        typer.Option(
            "--sized",
            help="For places seen from like distances again: learn from the keypoints' sizes, too.",
        ),
    ] = False,
    device: Annotated[str, typer.Option(help="cpu or cuda.")] = "cpu",
    threads: Annotated[
        int, typer.Option(help="CPU threads, 0 for one a core; take 1 on a busy machine.")
    ] = 0,
    resume: Annotated[
        bool, typer.Option("--resume", help="Continue from the checkpoint beside the output.")
    ] = False,
    name: Annotated[str, typer.Option(help="Name of the encoder; the output's if empty.")] = "",
    licence: Annotated[str, typer.Option(help="Licence of the weights, for the model file.")] = "",
    data_licence: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME=LICENCE", help="Licence of a sequence; may be repeated."),
    ] = None,
    json_file: Annotated[
        Path | None, typer.Option("--json", help="Write the figures to this file.")
    ] = None,
) -> None:
    """Train an encoder on tracks, and write it with its card (needs PyTorch).

    Works for any binary descriptor of 64 to 1024 bits: `protomark train my-tracks/*`. Beside the
    model come its card (.md) and a picture of the training (.png) that is drawn anew at each
    validation. Ctrl-C leaves a checkpoint, and the same command with --resume continues.
    """
    try:
        import torch  # noqa: F401
    except ModuleNotFoundError:
        raise ModuleNotFoundError(
            "training needs PyTorch, which is not installed: pip install protomark[train]"
        ) from None
    from protomark.inputs import chosen
    from protomark.training.command import (
        default_output,
        explain_interruption,
        print_summary,
        train_encoder,
    )
    from protomark.training.data import hold_out
    from protomark.training.train import Interrupted, Options

    try:
        parsed = tuple(int(d) for d in dims.split(","))
    except ValueError:
        raise ValueError(f"--dims {dims!r} is not a list of numbers such as 8,16,32") from None
    for entry in data_licence or []:
        if "=" not in entry:
            raise ValueError(f"--data-licence {entry!r} is not of the form NAME=LICENCE")
    data_licences = dict(entry.split("=", 1) for entry in data_licence or [])
    options = Options(dims=parsed, steps=steps, landmarks=batch, seed=seed)
    learned, picking = hold_out(tracks, validation or [])
    inputs = chosen(upright, sized)
    output = output or default_output(learned[0], resume, inputs)
    try:
        card = train_encoder(
            learned,
            picking,
            output,
            options,
            report=report or [],
            resume=resume,
            inputs=inputs,
            name=name,
            licence=licence,
            data_licences=data_licences,
            device=device,
            threads=threads,
            json_path=json_file,
        )
    except Interrupted as stop:
        explain_interruption(stop, output)
        raise typer.Exit(130) from None
    print_summary(card, output)


@app.command()
def build(
    tracks: Annotated[Path, typer.Argument(help="Tracks file that `protomark tracks` wrote.")],
    output: Annotated[Path, typer.Option("--output", "-o", help="Map file to write (.pmk).")],
    encoder: Annotated[
        str | None,
        typer.Option(help="Name or file of the encoder; by default the descriptor's own."),
    ] = None,
    dim: Annotated[
        int | None, typer.Option(help="Dimensions of a prototype; by default all.")
    ] = None,
    min_observations: Annotated[
        int, typer.Option(help="Leave out landmarks with fewer observations.")
    ] = 2,
    sealed: Annotated[
        bool, typer.Option("--sealed", help="Write a sealed map: smaller, and only answers.")
    ] = False,
    code_bits: Annotated[
        int, typer.Option(help="Bits of a sealed prototype's number: 8, or 4 for half the bytes.")
    ] = 8,
    look_bits: Annotated[
        int,
        typer.Option(
            min=0,
            help="Signs of a code that tell several looks of a landmark apart, each with a "
            "prototype of its own: more precise, more bytes. 0 to 16, 0 for one prototype a "
            "landmark.",
        ),
    ] = 0,
    prototypes: Annotated[
        float | None,
        typer.Option(
            help="Largest number of prototypes that a landmark of a sealed map has on average: "
            "looks are joined until it fits. By default all are kept."
        ),
    ] = None,
    index: Annotated[
        bool,
        typer.Option(
            "--index",
            help="Learn coarse cells, for approximate search in large maps: at most 4 bytes a "
            "landmark more.",
        ),
    ] = False,
    upright: Annotated[
        bool,
        typer.Option(
            "--upright",
            help="For cameras that do not roll: encode the keypoints' angles and sizes, too.",
        ),
    ] = False,
    sized: Annotated[
        bool,
        typer.Option(
            "--sized",
            help="For places seen from like distances again: encode the keypoints' sizes, too.",
        ),
    ] = False,
    position_bits: Annotated[
        int,
        typer.Option(
            help="Bits of a sealed position's coordinate: 32, or 16 for half the bytes, exact to a "
            "131068th of the map's extent."
        ),
    ] = 32,
    frame: Annotated[
        str | None,
        typer.Option(
            help="Coordinate frame of the positions and their unit, for the map's metadata: 'ENU, "
            "metres', 'COLMAP, no scale', 'map (REP 105), metres'."
        ),
    ] = None,
    metadata: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME=TEXT",
            help="What else the map shall say of itself; may be repeated. 'created' is now, or "
            "SOURCE_DATE_EPOCH where that is set.",
        ),
    ] = None,
    threads: Annotated[int, typer.Option(help="CPU threads.")] = 1,
    json_file: Annotated[
        Path | None, typer.Option("--json", help="Write the facts to this file.")
    ] = None,
) -> None:
    """Build a map from a tracks file: prototypes of each landmark, and its position."""
    from protomark.build import build_file
    from protomark.evaluation.command import check_outputs
    from protomark.info import describe, show
    from protomark.inputs import chosen
    from protomark.metadata import command_metadata

    check_outputs(output, json_file)
    texts = command_metadata(frame, metadata or [])
    build_file(
        tracks,
        output,
        encoder,
        dim,
        min_observations,
        sealed,
        threads,
        code_bits=code_bits,
        inputs=chosen(upright, sized),
        look_bits=look_bits,
        prototypes=prototypes,
        index=index,
        metadata=texts,
        position_bits=position_bits,
    )
    facts = describe(output)
    _write_json(json_file, facts)
    show(facts)


@app.command("map")
def map_(
    images: Annotated[
        Path, typer.Argument(metavar="IMAGES_OR_VIDEO", help="Folder of images, or a video file.")
    ],
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="Folder for the new map.")
    ] = None,
    into: Annotated[
        Path | None,
        typer.Option("--into", help="A map that `protomark map` made: extend it, in place."),
    ] = None,
    descriptor: Annotated[
        str,
        typer.Option(
            "--descriptor", "-d", help="freak, orb, brisk, akaze, latch, beblid or teblid."
        ),
    ] = "akaze",
    camera: Annotated[
        str | None,
        typer.Option(
            help="A COLMAP cameras.txt, a folder with a COLMAP model, or a camera written out: "
            "PINHOLE:525,525,320,240 or 'PINHOLE 640 480 525 525 320 240'. By default it is "
            "calibrated along the way."
        ),
    ] = None,
    focal: Annotated[
        float | None,
        typer.Option(
            help="Focal length to begin with, pixels; by default EXIF's, else 1.2 times the longer "
            "side."
        ),
    ] = None,
    poses: Annotated[
        Path | None,
        typer.Option(
            help="Given poses, then only landmarks are made: COLMAP model folder or images.txt, or "
            "a TUM trajectory."
        ),
    ] = None,
    every: Annotated[int, typer.Option(help="Take every n-th frame only.")] = 1,
    window: Annotated[
        int,
        typer.Option(help="Last keyframes that keep their descriptors, to make new landmarks."),
    ] = 8,
    dim: Annotated[int, typer.Option(help="Dimensions of a prototype.")] = 32,
    encoder: Annotated[
        str, typer.Option(help="Name or file of the encoder; by default the descriptor's own.")
    ] = "",
    memory: Annotated[
        str,
        typer.Option(
            help="What the map keeps: prototypes; or, to compare, medoids (one descriptor a "
            "landmark) or descriptors (all of them)."
        ),
    ] = "prototypes",
    max_keypoints: Annotated[
        int, typer.Option(help="Keypoints kept in a frame, strongest first, spread over it.")
    ] = 2000,
    resume: Annotated[
        bool, typer.Option("--resume", help="Go on with a map that Ctrl-C or a crash ended.")
    ] = False,
    force: Annotated[
        bool, typer.Option("--force", help="Make the map anew, though OUTPUT holds one.")
    ] = False,
    view: Annotated[
        bool,
        typer.Option("--view", help="Also write recording.rrd for the Rerun viewer."),
    ] = False,
    threads: Annotated[int, typer.Option(min=1, help="CPU threads to search and adjust on.")] = 1,
    json_file: Annotated[
        Path | None, typer.Option("--json", help="Write the figures to this file.")
    ] = None,
) -> None:
    r"""Make a map of a scene from images or a video, as they come: structure from motion.

    Each frame is matched with the prototypes of the map, updates those it sees, and is forgotten;
    only the last few keyframes keep descriptors. OUTPUT gets scene.pmk (the map), sparse/ (a COLMAP
    model), trajectory.txt (TUM format), report.html and report.json.

    protomark map walk.mp4 -o kitchen

    protomark map more-images/ --into kitchen

    Ctrl-C ends with what there is, and the same command with --resume goes on. --view needs
    `pip install protomark\[view]`. docs/mapping.md explains the pipeline.
    """
    from protomark.evaluation.command import check_outputs
    from protomark.mapping import command
    from protomark.mapping.settings import Settings

    if (output is None) == (into is None):
        raise ValueError("name a folder for the new map with -o, or a map to extend with --into")
    check_outputs(json_file)
    scene = output or into or Path()
    request = command.Request(
        images=images,
        output=scene,
        settings=Settings(
            descriptor=descriptor,
            max_keypoints=max_keypoints,
            memory=memory,
            encoder=encoder,
            dim=dim,
            window=window,
        ),
        camera=camera,
        focal=focal,
        poses=poses,
        every=every,
        resume=resume,
        extend=into is not None,
        force=force,
        view=view,
        threads=threads,
    )
    try:
        figures = command.make_map(request)
    except (command.Interrupted, KeyboardInterrupt):
        command.explain_interruption(scene)
        raise typer.Exit(130) from None
    _write_json(json_file, figures)
    command.show(figures, scene)


@app.command()
def localize(
    scene: Annotated[Path, typer.Argument(help="Map file (.pmk) whose landmarks have positions.")],
    images: Annotated[list[Path], typer.Argument(help="Images, or folders of images.")],
    output: Annotated[
        Path,
        typer.Option(
            "--output", "-o", help="Folder for images.txt, cameras.txt (COLMAP) and poses.csv."
        ),
    ] = Path("localized"),
    camera: Annotated[
        str | None,
        typer.Option(
            help="A COLMAP cameras.txt, a folder with a COLMAP model, or a camera written out: "
            "PINHOLE:525,525,320,240 or 'PINHOLE 640 480 525 525 320 240'. By default the focal "
            "length comes from EXIF data, or is estimated from matches."
        ),
    ] = None,
    refine_focal_length: Annotated[
        bool, typer.Option("--refine-focal-length", help="Refine it for each image.")
    ] = False,
    poses: Annotated[
        Path | None,
        typer.Option(
            help="True poses in the map's world, to measure recall: a COLMAP images.txt or model, "
            "or a TUM trajectory whose time stamps are the images' names."
        ),
    ] = None,
    priors: Annotated[
        Path | None,
        typer.Option(
            help="Rough poses, in the same formats: only landmarks that they make visible are "
            "searched."
        ),
    ] = None,
    prior_distance: Annotated[
        float, typer.Option(help="How far off a rough pose may be, in the map's units.")
    ] = 1.0,
    prior_degrees: Annotated[
        float, typer.Option(help="How far off its orientation may be, degrees.")
    ] = 15.0,
    min_confidence: Annotated[
        float,
        typer.Option(
            min=0, max=1, help="Poses that are less likely to be right are only in poses.csv."
        ),
    ] = 0.9,
    max_keypoints: Annotated[
        int, typer.Option(min=4, help="Keypoints kept in an image, strongest first.")
    ] = 2000,
    threads: Annotated[int, typer.Option(min=1, help="CPU threads to encode and search.")] = 1,
    json_file: Annotated[
        Path | None, typer.Option("--json", help="Write the figures to this file.")
    ] = None,
) -> None:
    """Say where images were taken, in a map, with a confidence for each pose.

    A map may be open or sealed; `protomark build` makes one from tracks. An image that cannot be
    read or was taken elsewhere does not end the run. docs/localization.md says more.
    """
    from protomark.evaluation.command import check_outputs
    from protomark.localization.command import Settings, localize_files, show

    check_outputs(json_file)
    results, interrupted = localize_files(
        scene,
        images,
        output,
        Settings(
            camera=camera,
            refine_focal_length=refine_focal_length,
            true_poses=poses,
            priors=priors,
            prior_distance=prior_distance,
            prior_degrees=prior_degrees,
            min_confidence=min_confidence,
            max_keypoints=max_keypoints,
            threads=threads,
        ),
    )
    _write_json(json_file, results.as_dict())
    show(results, output)
    if interrupted:
        raise typer.Exit(130)


@app.command()
def calibrate(
    model: Annotated[Path, typer.Argument(help="Model file (.pme) that `protomark train` wrote.")],
    tracks: Annotated[
        list[Path], typer.Argument(help="Tracks files, one a sequence, of the model's descriptor.")
    ],
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", help="Model file to write; by default MODEL itself."),
    ] = None,
    threads: Annotated[int, typer.Option(min=1, help="CPU threads.")] = 1,
    json_file: Annotated[
        Path | None, typer.Option("--json", help="Write the figures to this file.")
    ] = None,
) -> None:
    """Say in a model file which matches to accept, from frames whose landmarks are known.

    `protomark train` does this by itself. The probability that a match is right, given the
    distances to the two nearest landmarks, is fitted for each length of a code; the network stays
    the same, and so do maps made with it. docs/localization.md says more.
    """
    from protomark.calibration import calibrate_file, show
    from protomark.evaluation.command import check_outputs

    check_outputs(output or model, json_file)
    figures = calibrate_file(model, tracks, output or model, threads)
    _write_json(json_file, {"figures": [f.as_dict() for f in figures]})
    show(figures)


@app.command()
def join(
    maps: Annotated[
        list[Path],
        typer.Argument(metavar="MAP", help="Open maps of the same encoder, dim and look bits."),
    ],
    output: Annotated[Path, typer.Option("--output", "-o", help="Map file to write (.pmk).")],
    renumber: Annotated[
        bool,
        typer.Option(
            "--renumber",
            help="The maps have no landmark in common, whatever the ids say: those of each further "
            "map get new ids, above all before it.",
        ),
    ] = False,
    json_file: Annotated[
        Path | None, typer.Option("--json", help="Write the facts to this file.")
    ] = None,
) -> None:
    """Join maps that were built apart, exactly as if they had been one all along.

    Landmarks of one id are one landmark, and their observations are summed; the number of them is
    printed, as ids may be equal by accident. docs/sharing.md says more.
    """
    from protomark.evaluation.command import check_outputs
    from protomark.join import join_files, show

    check_outputs(output, json_file)
    facts = join_files(maps, output, renumber)
    _write_json(json_file, facts)
    show(facts)


@app.command()
def split(
    file: Annotated[Path, typer.Argument(metavar="MAP", help="An open map.")],
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder for the parts.")],
    ids: Annotated[
        str,
        typer.Option(help="Ids at which a part begins, ascending, for example 100000,200000."),
    ] = "",
    parts: Annotated[
        int | None, typer.Option(min=1, help="Number of parts by id, of as many landmarks each.")
    ] = None,
    cell_size: Annotated[
        float | None,
        typer.Option(
            help="Edge of the cubes into which space is cut, in the unit of the positions; "
            "landmarks without a position are a part of their own."
        ),
    ] = None,
    sealed: Annotated[bool, typer.Option("--sealed", help="Seal the parts.")] = False,
    json_file: Annotated[
        Path | None, typer.Option("--json", help="Write the facts to this file.")
    ] = None,
) -> None:
    """Split a map by id or by space, for maps that are served in parts.

    The parts have no index. `protomark join` makes the same map of them again.
    """
    from protomark.evaluation.command import check_outputs
    from protomark.split import show, split_file

    check_outputs(json_file)
    boundaries = list(_numbers("--ids", ids)) or None
    facts = split_file(file, output, boundaries, parts, cell_size, sealed)
    _write_json(json_file, facts)
    show(facts)


@app.command()
def info(
    file: Annotated[Path, typer.Argument(help="A map, an encoder or a tracks file.")],
    verify: Annotated[
        bool, typer.Option("--verify", help="Check every checksum of a map or an encoder.")
    ] = False,
    json_file: Annotated[
        Path | None, typer.Option("--json", help="Write the facts to this file.")
    ] = None,
) -> None:
    """Say what a file holds."""
    from protomark import verify_file
    from protomark.console import progress_console
    from protomark.info import describe, show

    with progress_console.status(f"Reading {file.name}"):
        facts = describe(file)
        if verify and facts["kind"] != "tracks":
            verify_file(file)
            facts["checksums"] = "all right"
    _write_json(json_file, facts)
    show(facts)


@app.command()
def demo(
    output: Annotated[
        Path, typer.Option("--output", "-o", help="Folder for the maps and the picture.")
    ] = Path("demo"),
    encoder: Annotated[
        str | None,
        typer.Option(help="Name or file of an encoder; by default the descriptor's own."),
    ] = None,
    tracks: Annotated[
        Path | None, typer.Option(help="Another tracks file than the sample that ships.")
    ] = None,
    json_file: Annotated[
        Path | None, typer.Option("--json", help="Write the figures to this file.")
    ] = None,
) -> None:
    """Build a map of the bundled sample, localize new keyframes in it, and compare."""
    from protomark.demo import run_demo, show
    from protomark.evaluation.command import check_outputs

    check_outputs(json_file)
    result = run_demo(output, tracks_path=tracks, encoder=encoder)
    _write_json(json_file, result.as_dict())
    show(result)


@app.command()
def evaluate(
    tracks: Annotated[
        list[Path], typer.Argument(help="Tracks files that `protomark tracks` wrote.")
    ],
    encoder: Annotated[
        list[str] | None,
        typer.Option(
            help="Name or file of an encoder; may be repeated. By default the descriptor's own."
        ),
    ] = None,
    upright: Annotated[
        bool,
        typer.Option(
            "--upright",
            help="Give Protomark the keypoints' angles and sizes, too (encoders such as "
            "freak-upright); all other methods get the plain descriptors.",
        ),
    ] = False,
    sized: Annotated[
        bool,
        typer.Option(
            "--sized",
            help="Give Protomark the keypoints' sizes, too (encoders such as freak-sized).",
        ),
    ] = False,
    methods: Annotated[
        str,
        typer.Option(
            help="Methods to compare, for example unaggregated,medoid,pca,protomark; "
            "by default all but the -float variants."
        ),
    ] = "",
    seeds: Annotated[int, typer.Option(min=1, help="Random splits, with seeds 0, 1, ...")] = 3,
    pose_frames: Annotated[
        int, typer.Option(min=0, help="Query keyframes to localize at each seed, at most.")
    ] = 20,
    discriminant_from: Annotated[
        list[Path] | None,
        typer.Option(
            help="Tracks file to learn the linear discriminants from; may be repeated. "
            "By default they are learned from the support."
        ),
    ] = None,
    threads: Annotated[
        int, typer.Option(min=0, help="CPU threads, 0 for all; search is timed on one.")
    ] = 0,
    json_file: Annotated[
        Path | None, typer.Option("--json", help="Write the figures to this file.")
    ] = None,
    markdown_file: Annotated[
        Path | None, typer.Option("--markdown", help="Write the tables to this file.")
    ] = None,
    plot_file: Annotated[
        Path | None,
        typer.Option("--plot", help="Draw precision over bytes to this file (.png, .svg, .pdf)."),
    ] = None,
) -> None:
    """Compare precision, poses, bytes and search time of prototypes and of other methods.

    The protocol is the paper's: a random 90 % of the keyframes build the map, descriptors of the
    others ask it. docs/evaluation.md describes it, and every method.
    """
    from protomark.evaluation import command
    from protomark.evaluation.run import Options
    from protomark.evaluation.threads import available_threads
    from protomark.inputs import chosen

    command.check_plot(plot_file)
    command.check_outputs(json_file, markdown_file, plot_file)
    results = command.evaluate_files(
        tracks,
        Options(
            seeds=range(seeds), pose_frames=pose_frames, threads=threads or available_threads()
        ),
        encoders=encoder or [],
        methods=[name.strip() for name in methods.split(",") if name.strip()],
        discriminant_from=discriminant_from or [],
        inputs=chosen(upright, sized),
    )
    command.write(results, json_file, markdown_file, plot_file)


@app.command("evaluate-mapping")
def evaluate_mapping(
    sequences: Annotated[
        list[Path],
        typer.Argument(
            metavar="SEQUENCES",
            help="Folders that hold images/ and, with the camera and the true poses, a COLMAP "
            "model in sparse/.",
        ),
    ],
    output: Annotated[
        Path,
        typer.Option("--output", "-o", help="Folder for the report and all that is kept."),
    ] = Path("mapping-evaluation"),
    variants: Annotated[
        str,
        typer.Option(
            help="What maps keep of descriptors, of traditional (all of them), medoid, "
            "prototypes-32 and prototypes-16, with commas between; by default all."
        ),
    ] = "",
    colmap: Annotated[
        bool, typer.Option(help="Also COLMAP's own incremental reconstruction with SIFT.")
    ] = True,
    every: Annotated[int, typer.Option(min=1, help="Take every n-th image only.")] = 1,
    frames: Annotated[
        int, typer.Option(min=0, help="Take the first so many of those only, 0 for all.")
    ] = 0,
    halves: Annotated[
        Path | None,
        typer.Option(
            help="Tracks file, its poses in metres: also localize its second half in a map of its "
            "first half (--frames frames of it at most)."
        ),
    ] = None,
    calibrate: Annotated[
        list[Path] | None,
        typer.Option(
            help="Tracks file of another sequence, to learn there which matches are right, for "
            "--halves; may be repeated."
        ),
    ] = None,
    descriptor: Annotated[
        str,
        typer.Option(
            "--descriptor", "-d", help="As `protomark map` takes them; the paper's is freak."
        ),
    ] = "akaze",
    encoder: Annotated[
        str, typer.Option(help="Name or file of the encoder; by default the descriptor's own.")
    ] = "",
    max_keypoints: Annotated[
        int, typer.Option(help="Keypoints kept in a frame, strongest first, spread over it.")
    ] = 2000,
    threads: Annotated[int, typer.Option(min=1, help="CPU threads of every run.")] = 1,
    json_file: Annotated[
        Path | None, typer.Option("--json", help="Write the figures to this file too.")
    ] = None,
) -> None:
    """Map sequences with all descriptors, medoids and prototypes, and compare, with COLMAP too.

    Frames registered, trajectory error against the true poses, landmarks, time and descriptor
    bytes, all variants in the same code, poses unknown and the camera known. OUTPUT gets report.md
    with its plots and report.json. Finished runs are kept and reported: after Ctrl-C the same
    command goes on. A short run: --frames 60 --no-colmap.
    """
    from protomark.evaluation.command import check_outputs
    from protomark.evaluation.mapping import command
    from protomark.evaluation.mapping.variants import choose
    from protomark.mapping.settings import Settings

    check_outputs(json_file)
    if halves is not None and not calibrate:
        raise ValueError("--halves needs tracks of another sequence, give them with --calibrate")
    flags = [f"--variants {variants}"] if variants else []
    flags += [] if colmap else ["--no-colmap"]
    flags += [f"--every {every}"] if every > 1 else []
    flags += [f"--frames {frames}"] if frames else []
    flags += [f"--halves {halves.name}"] if halves is not None else []
    flags += [f"--calibrate {path.name}" for path in calibrate or []]
    flags += [f"-d {descriptor}"] if descriptor != "akaze" else []
    flags += [f"--encoder {Path(encoder).name}"] if encoder else []
    flags += [f"--max-keypoints {max_keypoints}"] if max_keypoints != 2000 else []
    flags += [f"--threads {threads}"] if threads != 1 else []
    names = [path.resolve().name for path in sequences]
    request = command.Request(
        sequences=sequences,
        output=output,
        variants=choose([name.strip() for name in variants.split(",") if name.strip()]),
        base=Settings(descriptor=descriptor, encoder=encoder, max_keypoints=max_keypoints),
        colmap=colmap,
        every=every,
        frames=frames,
        halves=halves,
        calibrate=calibrate or [],
        threads=threads,
        repeat=" ".join(["protomark evaluate-mapping", *names, *flags]),
    )
    try:
        results = command.evaluate_mapping(request, json_file)
    except KeyboardInterrupt:
        command.explain_interruption(output)
        raise typer.Exit(130) from None
    command.print_summary(results, output)


@app.command()
def reproduce(
    data: Annotated[
        list[Path] | None,
        typer.Argument(
            metavar="DATA",
            help="Tracks files, folders of them, or folders of sequences with images/ and "
            "sparse/, whose tracks are made first. By default the sequences in data, ../data or "
            "../shared/data.",
        ),
    ] = None,
    output: Annotated[
        Path,
        typer.Option("--output", "-o", help="Folder for the report and all that is kept."),
    ] = Path("reproduction"),
    scale: Annotated[
        str,
        typer.Option(
            help="small: minutes, on the sequences whose tracks are quickly made; medium: all "
            "sequences, short trainings; full: trained until the validation loss stagnates, hours."
        ),
    ] = "small",
    descriptor: Annotated[
        str, typer.Option("--descriptor", "-d", help="Descriptor; the paper's is freak.")
    ] = "freak",
    train: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME", help="Sequence to train on; may be repeated."),
    ] = None,
    validation: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME", help="Sequence to pick networks on; may be repeated."),
    ] = None,
    test: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME", help="Sequence to measure on; may be repeated."),
    ] = None,
    jobs: Annotated[
        int, typer.Option(min=0, help="Trainings at a time, 0 for as many as cores allow.")
    ] = 0,
    threads: Annotated[int, typer.Option(min=1, help="CPU threads of one training.")] = 1,
    json_file: Annotated[
        Path | None, typer.Option("--json", help="Write the figures to this file too.")
    ] = None,
) -> None:
    """Run the paper's whole evaluation again and report it beside the paper's numbers.

    Trains 'fat' and 'funnel' networks of 2 to 5 layers as triplet and as prototypical networks,
    compares prototypes of 8 to 64 dimensions and the other methods of the paper's table, and
    writes report.md with its figures (needs PyTorch). Finished trainings are kept: after Ctrl-C
    the same command goes on. Sequences of other names than the project's own need --train,
    --validation and --test. docs/reproduction.md says more.
    """
    try:
        import torch  # noqa: F401
    except ModuleNotFoundError:
        raise ModuleNotFoundError(
            "reproduce trains networks with PyTorch, which is not installed: "
            "pip install protomark[train]"
        ) from None
    from protomark.evaluation.threads import available_threads
    from protomark.reproduce import command
    from protomark.reproduce.scale import find_scale

    settings = command.Settings(
        scale=find_scale(scale),
        descriptor=descriptor,
        jobs=jobs or max(available_threads() // threads, 1),
        threads=threads,
        given={"training": train or [], "validation": validation or [], "test": test or []},
    )
    try:
        results = command.reproduce(data or [], output, settings, json_file)
    except KeyboardInterrupt:
        command.explain_interruption(output)
        raise typer.Exit(130) from None
    command.print_summary(results, output)


@app.command()
def bench(
    tracks: Annotated[
        list[Path] | None,
        typer.Argument(
            metavar="TRACKS",
            help="Tracks files of one descriptor, to grow data from; by default the sample.",
        ),
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", help="Folder for the report: benchmarks.md and its plots."),
    ] = None,
    only: Annotated[
        str,
        typer.Option(
            help="Sections, for example encode,search; of encode, search, hamming, approximate, "
            "real, frame, add, growth and large. By default all."
        ),
    ] = "",
    full: Annotated[
        bool,
        typer.Option("--full", help="Also 10 and 100 million landmarks: hours, and much memory."),
    ] = False,
    quick: Annotated[
        bool, typer.Option("--quick", help="Tiny sizes: whether it runs, not how fast.")
    ] = False,
    landmarks: Annotated[
        str,
        typer.Option(
            help="Sizes of the maps that are searched (search, hamming, approximate, growth; of "
            "large the last one), for example 10000,1000000, in place of the usual ones."
        ),
    ] = "",
    graphs: Annotated[
        Literal["all", "one", "none"],
        typer.Option(
            help="Which graphs are raced on maps of --landmarks, where they build for hours: all, "
            "one (hnswlib), or none."
        ),
    ] = "all",
    threads: Annotated[int, typer.Option(min=1, help="CPU threads of every contender.")] = 1,
    scratch: Annotated[
        Path | None,
        typer.Option(help="Folder for maps that are thrown away; the system's by default."),
    ] = None,
    json_file: Annotated[
        Path | None, typer.Option("--json", help="Write the figures to this file.")
    ] = None,
) -> None:
    r"""Measure speed beside PyTorch, ONNX Runtime, FAISS, OpenCV, hnswlib and USearch.

    All contenders take turns in one run, on the same data and as many threads; ratios come with
    their spread, and beside the machine's own ceilings. Peers that are not installed are left out:
    `pip install protomark\[bench]`. Ctrl-C ends the run and keeps what is measured.
    docs/benchmarks.md holds a whole run.
    """
    import tempfile

    from protomark.bench import command
    from protomark.bench.settings import choose
    from protomark.evaluation.command import check_outputs
    from protomark.evaluation.threads import available_threads

    check_outputs(json_file)
    settings = choose(
        sections=tuple(name.strip() for name in only.split(",") if name.strip()),
        threads=threads,
        build_threads=available_threads(),
        full=full,
        quick=quick,
        scratch=scratch or Path(tempfile.gettempdir()),
        landmarks=_numbers("--landmarks", landmarks),
        graphs=graphs,
    )
    flags = [f"--only {only}"] if only else []
    flags += [f"--landmarks {landmarks}"] if landmarks else []
    flags += [f"--graphs {graphs}"] if graphs != "all" else []
    flags += ["--full"] if full else ["--quick"] if quick else []
    flags += [f"--threads {threads}"] if threads != 1 else []
    repeat = " ".join(["protomark bench", *(path.name for path in tracks or []), *flags])
    results = command.bench(tracks or [], settings, output, json_file, repeat)
    command.print_summary(results, output)
    if results.interrupted:
        raise typer.Exit(130)


def _numbers(option: str, text: str) -> tuple[int, ...]:
    """The numbers of a list such as 10000,1000000."""
    try:
        return tuple(int(number) for number in text.split(",") if number.strip())
    except ValueError:
        raise ValueError(f"{option} {text}: not numbers with commas between them") from None


def _write_json(path: Path | None, facts: dict[str, Any]) -> None:
    if path is not None:
        from protomark.files import write_text

        write_text(path, json.dumps(facts, indent=2) + "\n")


def _print_version(wanted: bool) -> None:
    if wanted:
        from protomark import __version__

        typer.echo(f"protomark {__version__}")
        raise typer.Exit


@app.callback()
def options(
    version: Annotated[
        bool,
        typer.Option(
            "--version", callback=_print_version, is_eager=True, help="Print the version."
        ),
    ] = False,
) -> None:
    """One small integer prototype per landmark instead of all its binary descriptors."""


def main() -> None:
    """Run the command; an expected error becomes one sentence on stderr and exit code 1."""
    from rich.markup import escape

    from protomark.console import progress_console

    try:
        app()
    except (ValueError, OSError, KeyError, ModuleNotFoundError) as error:
        text = error.args[0] if isinstance(error, KeyError) and error.args else error
        message = f"[bold red]error:[/] {escape(str(text))}"
        progress_console.print(message, highlight=False, soft_wrap=True)
        raise SystemExit(1) from None


if __name__ == "__main__":
    main()
