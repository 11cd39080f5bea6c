"""`sceneprint sign`: frames to signatures."""

from __future__ import annotations

import argparse
import hashlib
import json
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tqdm import tqdm

from sceneprint.atomic_files import write_whole
from sceneprint.cli.bag import add_recording_options, sequences_at
from sceneprint.cli.output import one_line
from sceneprint.cli.preparation import add_model_options, open_for
from sceneprint.errors import DatasetError, FrameError
from sceneprint.formats.dataset import FrameReference
from sceneprint.pipeline import Signature, Signer, sign
from sceneprint.settings import Settings


def add_sign(command: argparse.ArgumentParser) -> None:
    """Add the options of `sceneprint sign`."""
    command.add_argument("paths", nargs="+", type=Path, metavar="PATH")
    add_model_options(command)
    command.add_argument(
        "--psi", action="store_true",
        help="sign with psi, the Fisher vectors of the paper, from the given model or else the "
        "preset paper",
    )  # fmt: skip
    command.add_argument(
        "--out", type=Path, metavar="DIR",
        help="write one FRAME.sig per frame (the bytes of the signature) and signatures.json",
    )  # fmt: skip
    add_recording_options(command)
    command.set_defaults(run=run_sign)


@dataclass(frozen=True, eq=False)
class Signed:
    """One frame's outcome: a signature with its time, or the reason why there is none."""

    reference: FrameReference
    name: str
    signature: Signature | None
    milliseconds: float
    reason: str = ""


def named_frames(options: argparse.Namespace) -> list[tuple[str, FrameReference]]:
    """All frames below the paths, under names that are unique among them.

    Raises
    ------
    DatasetError : nothing is found at a path, or one path was given twice.
    """
    frames: dict[str, FrameReference] = {}
    files: set[Path] = set()
    paths = options.paths
    for path in paths:
        several = len(paths) > 1 and path.is_dir()  # a file is named by its folder already
        prefix = f"{path.resolve().name}/" if several else ""
        for sequence in sequences_at(path, options):
            for reference in sequence.frames:
                known = reference.name.startswith(prefix)
                name = reference.name if known else prefix + reference.name
                if name in frames or reference.path.resolve() in files:
                    first = frames[name].path if name in frames else "another of the paths"
                    raise DatasetError(
                        f"{path}: {name} is also the name of {first}. Sign the two in separate "
                        "runs."
                    )
                frames[name] = reference
                files.add(reference.path.resolve())
    return list(frames.items())


def run_sign(options: argparse.Namespace) -> int:
    """Sign every frame of the given files and folders (7-Scenes, TUM RGB-D or plain depth
    images, with an intrinsics.json beside them or in a folder above; or point clouds).
    """
    frames = named_frames(options)
    signer = open_for(options, Settings(), psi=options.psi)
    if options.out is not None:
        _claim(options.out, signer)
    done: list[Signed] = []
    heard = True  # whether anybody still reads the lines
    try:
        with tqdm(frames, desc="sign", unit="frame", disable=None) as bar:
            for name, reference in bar:
                one = _sign(name, reference, signer)
                if options.out is not None:
                    _write_signature(options.out / f"{name}.sig", one.signature)
                done.append(one)
                try:
                    if heard:
                        bar.write(_line(one, signer))
                except BrokenPipeError:
                    if options.out is None:
                        raise
                    heard = False
    finally:  # what was written is listed, however the run ended
        if options.out is not None:
            _write_index(options.out, done, signer)
    return _report(done, signer)


def _claim(folder: Path, signer: Signer) -> None:
    """Make the folder, or see that it holds signatures of this model."""
    folder.mkdir(parents=True, exist_ok=True)
    index = folder / "signatures.json"
    try:
        known = json.loads(index.read_text())["model"]["id"] if index.exists() else None
    except (ValueError, KeyError, TypeError):
        known = "no readable model id"
    if known not in (None, signer.model.id):
        raise DatasetError(
            f"{folder}: holds signatures of another model ({known[:12]}, not "
            f"{signer.model.id[:12]}), and models must not be mixed. Use a new folder, or empty "
            "this one."
        )


def _sign(name: str, reference: FrameReference, signer: Signer) -> Signed:
    try:
        frame = reference.read()
        start = time.perf_counter()
        signature = sign(frame, signer)
        return Signed(reference, name, signature, 1e3 * (time.perf_counter() - start))
    except FrameError as error:
        return Signed(reference, name, None, 0.0, str(error))


def _line(one: Signed, signer: Signer) -> str:
    name = one_line(one.name)
    if one.signature is None:
        return f"{name}  NOT SIGNED  {one_line(one.reason)}"
    patches = "/".join(map(str, one.signature.n_patches))
    return (
        f"{name}  {patches} patches  {sum(one.signature.n_pairs)} pairs  "
        f"{one.milliseconds:.0f} ms  {signer.model.label}"
    )


def _write_signature(path: Path, signature: Signature | None) -> None:
    """Write it, or where there is none now, see that an earlier one does not stay."""
    if signature is None:
        path.unlink(missing_ok=True)
        return
    path.parent.mkdir(parents=True, exist_ok=True)
    write_whole(path, signature.vector.tobytes())


def _write_index(folder: Path, done: list[Signed], signer: Signer) -> None:
    model = signer.model
    index = {
        "model": {
            "name": model.name,
            "id": model.id,
            "signature_bytes": model.signature_bytes,
            "metric": model.metric,
            "unrelated_distance": model.unrelated_distance,
        },
        "frames": [_entry(one) for one in done],
    }
    write_whole(folder / "signatures.json", (json.dumps(index, indent=1) + "\n").encode())


def _entry(one: Signed) -> dict[str, Any]:
    entry: dict[str, Any] = {"name": one.name, "path": str(one.reference.path)}
    if one.signature is None:
        return entry | {"signed": False, "reason": one.reason}
    return entry | {
        "signed": True,
        "file": f"{one.name}.sig",
        "sha256": hashlib.sha256(one.signature.vector.tobytes()).hexdigest(),
        "patches": list(one.signature.n_patches),
        "pairs": list(one.signature.n_pairs),
        "milliseconds": round(one.milliseconds, 1),
    }


def _report(done: list[Signed], signer: Signer) -> int:
    times = sorted(one.milliseconds for one in done if one.signature is not None)
    failed = len(done) - len(times)
    median = f", median {times[len(times) // 2]:.0f} ms" if times else ""
    print(
        f"{len(times)} of {len(done)} frames signed{median}; {signer.model.signature_bytes} bytes "
        f"each; model {signer.model.label}",
        file=sys.stderr,
    )
    if failed:
        print(f"{failed} could not be signed; see their lines above", file=sys.stderr)
    return 2 if failed else 0
