"""The `nrsfm` command.

PyTorch, SciPy and plotly take seconds to load. So the commands import what they need themselves, and only after
they have looked at the arguments and files: a slip of the pen is answered at once.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from . import __version__, experiments

if TYPE_CHECKING:
    import numpy as np

    from .data import Landmarks, Reconstruction

_FORMATS = ("npz", "bvh")
_BANDS = "draw each point's 90 % band in the scene"


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line.

    Parameters
    ----------
    argv : sequence of str, optional
        Default: the words that the program was called with.

    Returns
    -------
    The exit code: 0, 2 after one sentence on bad input, or 130 after an interruption.

    Examples
    --------
    >>> nl.cli.main(["reconstruct", "points.npz", "--out", "scene.html"])  # doctest: +SKIP
    0
    """
    arguments = _parser().parse_args(argv)
    try:
        arguments.run(arguments)
    except (ValueError, OSError, KeyError, FloatingPointError) as error:
        # A KeyError prints its message in quotes; its first argument is the sentence itself.
        sentence = error.args[0] if isinstance(error, KeyError) else error
        print(f"nrsfm: {sentence}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("nrsfm: interrupted.", file=sys.stderr)
        return 130
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="nrsfm", description="Non-rigid structure from motion: 2D landmarks in, 3D shapes and cameras out."
    )
    parser.add_argument("--version", action="version", version=f"nrsfm {__version__}")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")

    make = commands.add_parser(
        "reconstruct",
        help="2D landmarks in, 3D out",
        description="Reconstruct the landmarks of FILE. A file of 3D motion is first photographed by one "
        "random orthographic camera per frame, and the error against its truth is printed.",
    )
    make.add_argument("file", type=Path, metavar="FILE")
    make.add_argument("--format", choices=("auto", *_FORMATS), default="auto", help="default: by the file's ending")
    make.add_argument("--out", type=Path, metavar="SCENE.html", help="write a 3D scene that opens offline")
    make.add_argument("--save", type=Path, metavar="RESULT.npz", help="keep shapes, cameras and the network")
    make.add_argument("--joints", metavar="A,B,…", help="bvh: only these joints, or 'cmu' for a 31-point body")
    make.add_argument("--every", type=int, default=1, metavar="N", help="bvh: keep every N-th frame")
    make.add_argument("--steps", type=int, help="training steps")
    make.add_argument("--seed", type=int, default=0, help="decides the training's start and order, and the cameras")
    make.add_argument("--checkpoint", type=Path, help="keep the state here, and go on from it if it exists")
    make.add_argument("--occlusion", action="store_true", help="hidden points lie behind: decides the mirror image")
    make.add_argument("--uncertainty", action="store_true", help=_BANDS)
    make.add_argument("--quiet", action="store_true", help="no progress bar")
    make.set_defaults(run=_reconstruct)

    view = commands.add_parser("view", help="a saved reconstruction as a 3D scene")
    view.add_argument("file", type=Path, metavar="RESULT.npz")
    view.add_argument("--out", type=Path, required=True, metavar="SCENE.html")
    view.add_argument("--uncertainty", action="store_true", help=_BANDS)
    view.set_defaults(run=_view)

    experiment = commands.add_parser(
        "experiment",
        help="repeat a measurement of the book",
        description="Make results/NAME.csv and results/NAME.json. A run that was stopped goes on where it was.",
    )
    experiment.add_argument("name", metavar="NAME", choices=experiments.NAMES, help=", ".join(experiments.NAMES))
    experiment.add_argument("--quick", action="store_true", help="a short form, into _build/results")
    experiment.add_argument("--out", type=Path, metavar="FOLDER", help="another folder for the results")
    experiment.set_defaults(run=_experiment)
    return parser


def _reconstruct(arguments: argparse.Namespace) -> None:
    kind = _kind(arguments)
    _check_targets(arguments.out, arguments.save, arguments.checkpoint)
    _check_numbers(arguments)
    data = _load(arguments, kind)
    from . import datasets, metrics
    from .reconstruction import reconstruct

    if data.points2d is None:
        data = datasets.make_views(data, seed=arguments.seed)
        print(f"{len(data)} frames of {data.n_points} points, seen by one random orthographic camera each")
    else:
        print(f"{len(data)} frames of {data.n_points} points")
    rec = reconstruct(
        data, seed=arguments.seed, steps=arguments.steps, checkpoint=arguments.checkpoint,
        occlusion=arguments.occlusion, progress=not arguments.quiet,
    )  # fmt: skip
    if data.points3d is not None:
        error = metrics.normalized_error(rec.shapes, data.points3d).mean()
        turned = metrics.rotation_only_error(rec.shapes, data.points3d).mean()
        hand = metrics.handedness(rec.shapes, data.points3d)
        print(f"mean normalised 3D error: {error:.4f} (each frame scaled, turned and mirrored onto the truth)")
        print(f"with rotations only: {turned:.4f} (all frames mirrored, or none)")
        if hand.left_out < 1:  # else the truth is flat, and has no hand
            print(f"frames mirrored against the others: {hand.mirrored:.1%}")
    if rec.uncertainty is not None:
        print(f"points may be off by {rec.doubt:.1%} of the object's size, in the mean")
    if rec.agreement is not None:
        print(f"shapes from another start differ by {rec.agreement:.3f} (normalised; small is a good sign)")
    print(f"coherence of the last dictionary: {rec.coherence:.3f}")
    if arguments.save:
        print(f"wrote {rec.save(arguments.save)}")
    if arguments.out:
        _write_scene(rec, arguments, truth=data.points3d)


def _check_targets(*targets: Path | None) -> None:
    """Find out before the training, not after it, that a result cannot be written."""
    for target in targets:
        if target is not None and not target.parent.is_dir():
            raise FileNotFoundError(f"{target.parent}: no such folder to write {target.name} to.")
        if target is not None and target.is_dir():
            raise ValueError(f"{target}: is a folder; expected the name of a file to write.")


def _check_numbers(arguments: argparse.Namespace) -> None:
    from .checks import whole

    for name, least in (("steps", 1), ("every", 1), ("seed", 0)):
        value = getattr(arguments, name)
        if value is not None:
            whole(f"--{name}", value, least)


def _kind(arguments: argparse.Namespace) -> str:
    """The format of the file, after a look at its name and size."""
    file, kind = arguments.file, arguments.format
    _check_there(file)
    if kind == "auto":
        kind = "bvh" if file.is_dir() else file.suffix.lower().removeprefix(".")
    if file.is_file() and file.stat().st_size == 0:
        raise ValueError(f"{file}: the file is empty.")
    if kind not in _FORMATS:
        raise ValueError(f"{file}: cannot tell the format from its ending; give --format {' or '.join(_FORMATS)}.")
    if kind == "npz" and (arguments.joints is not None or arguments.every != 1):
        raise ValueError("--joints and --every are for .bvh files; points in an .npz are taken as they are.")
    return kind


def _check_there(file: Path) -> None:
    if not file.exists():
        raise FileNotFoundError(f"{file}: no such file.")


def _load(arguments: argparse.Namespace, kind: str) -> Landmarks:
    from . import datasets

    if kind == "npz":
        return datasets.load_npz(arguments.file)
    joints = arguments.joints
    if joints is not None:
        joints = datasets.CMU_BODY if joints == "cmu" else [joint.strip() for joint in joints.split(",")]
    return datasets.load_bvh(arguments.file, joints=joints, every=arguments.every)


def _view(arguments: argparse.Namespace) -> None:
    _check_there(arguments.file)
    _check_targets(arguments.out)
    from .data import Reconstruction

    _write_scene(Reconstruction.load(arguments.file), arguments)


def _experiment(arguments: argparse.Namespace) -> None:
    experiments.run(arguments.name, quick=arguments.quick, folder=arguments.out)


def _write_scene(rec: Reconstruction, arguments: argparse.Namespace, truth: np.ndarray | None = None) -> None:
    from . import plotting

    figure = plotting.show3d(
        rec, truth=truth, uncertainty=arguments.uncertainty, max_frames=150, title=arguments.file.name, height=700
    )
    plotting.write_html(figure, arguments.out)
    print(f"wrote {arguments.out}")


if __name__ == "__main__":
    sys.exit(main())
