"""`sceneprint sign`: signatures of frames without a service."""

from __future__ import annotations

import argparse
import hashlib
import json
import time
from pathlib import Path
from typing import Any

from tqdm import tqdm

from sceneprint.atomic_files import write_whole
from sceneprint.cli.bag import add_recording_options, sequences_at
from sceneprint.cli.output import one_line, print_error
from sceneprint.cli.preparation import add_model_options, open_signer_of
from sceneprint.errors import DatasetError, FrameError
from sceneprint.formats.dataset import FrameReference
from sceneprint.pipeline import Signer, sign
from sceneprint.settings import Settings


def add_sign(command: argparse.ArgumentParser) -> None:
    """Add the options of `sceneprint sign`."""
    command.add_argument("paths", nargs="+", type=Path, metavar="PATH")
    add_model_options(command)
    command.add_argument(
        "--psi", action="store_true",
        help="compute psi, the Fisher vectors of the paper, with the specified model or the preset "
        "paper",
    )  # fmt: skip
    command.add_argument(
        "--out", type=Path, metavar="DIR",
        help="write one FRAME.sig per frame (the bytes of the signature) and signatures.json",
    )  # fmt: skip
    add_recording_options(command)
    command.set_defaults(run=run_sign)


def run_sign(options: argparse.Namespace) -> int:
    """Sign all frames of files and folders (7-Scenes, TUM RGB-D, depth images with an
    intrinsics.json beside them or in a folder above, or point clouds). The exit code is 2 if a
    frame could not be signed.
    """
    frames, out = _named_frames(options), options.out
    signer = open_signer_of(options, Settings(), psi=options.psi)
    if out is not None:
        _prepare_folder(out, signer)
    entries: list[dict[str, Any]] = []
    has_reader = True  # whether standard output is open
    try:
        with tqdm(frames.items(), desc="sign", unit="frame", disable=None) as bar:
            for name, reference in bar:
                entry, line = _sign(name, reference, signer, out)
                entries.append(entry)
                try:
                    if has_reader:
                        bar.write(line)
                except BrokenPipeError:
                    if out is None:
                        raise
                    has_reader = False
    finally:  # list the written signatures even after an error
        if out is not None:
            names = ("name", "id", "signature_bytes", "metric", "unrelated_distance")
            model = {name: getattr(signer.model, name) for name in names}
            index = {"model": model, "frames": entries}
            write_whole(out / "signatures.json", (json.dumps(index, indent=1) + "\n").encode())
    times = sorted(entry["milliseconds"] for entry in entries if entry["signed"])
    median = f", median {times[len(times) // 2]:.0f} ms" if times else ""
    print_error(
        f"{len(times)} of {len(entries)} frames signed{median}; {signer.model.signature_bytes} "
        f"bytes each; model {signer.model.label}"
    )
    if len(times) < len(entries):
        print_error(f"{len(entries) - len(times)} could not be signed; see their lines above")
        return 2
    return 0


def _named_frames(options: argparse.Namespace) -> dict[str, FrameReference]:
    """Return all frames under the paths, by unique name.

    Raise DatasetError if a path has no frames, or a name or file occurs twice.
    """
    frames: dict[str, FrameReference] = {}
    files: set[Path] = set()
    for path in options.paths:
        several = len(options.paths) > 1 and path.is_dir()  # file names are unique
        prefix = f"{path.resolve().name}/" if several else ""
        for sequence in sequences_at(path, options):
            for reference in sequence.frames:
                name = prefix + reference.name.removeprefix(prefix)
                if name in frames or reference.path.resolve() in files:
                    first = frames[name].path if name in frames else "another of the paths"
                    raise DatasetError(
                        f"{path}: {name} is also the name of {first}. Sign the two in separate "
                        "runs."
                    )
                frames[name] = reference
                files.add(reference.path.resolve())
    return frames


def _prepare_folder(folder: Path, signer: Signer) -> None:
    """Create a folder; raise DatasetError if it contains signatures of another model."""
    folder.mkdir(parents=True, exist_ok=True)
    index = folder / "signatures.json"
    try:
        model_id = json.loads(index.read_text())["model"]["id"] if index.exists() else None
    except (ValueError, KeyError, TypeError):
        model_id = "no readable model id"
    if model_id not in (None, signer.model.id):
        raise DatasetError(
            f"{folder}: contains signatures of another model ({model_id[:12]}, not "
            f"{signer.model.id[:12]}), and models must not be mixed. Use a new folder, or empty "
            "this one."
        )


def _sign(
    name: str, reference: FrameReference, signer: Signer, out: Path | None
) -> tuple[dict[str, Any], str]:
    """Sign a frame and write its signature; return its entry in the index, and its output line.

    If the frame cannot be signed, both state the reason, and the file of an earlier run is removed.
    """
    entry: dict[str, Any] = {"name": name, "path": str(reference.path)}
    file = None if out is None else out / f"{name}.sig"
    try:
        frame = reference.read()
        start = time.perf_counter()
        signature = sign(frame, signer)
    except FrameError as error:
        if file is not None:
            file.unlink(missing_ok=True)  # the outdated signature of an earlier run
        line = f"{one_line(name)}  NOT SIGNED  {one_line(str(error))}"
        return entry | {"signed": False, "reason": str(error)}, line
    milliseconds = 1e3 * (time.perf_counter() - start)
    content = signature.vector.tobytes()
    if file is not None:
        file.parent.mkdir(parents=True, exist_ok=True)
        write_whole(file, content)
    entry |= {
        "signed": True,
        "file": f"{name}.sig",
        "sha256": hashlib.sha256(content).hexdigest(),
        "patches": list(signature.n_patches),
        "pairs": list(signature.n_pairs),
        "milliseconds": round(milliseconds, 1),
    }
    return entry, (
        f"{one_line(name)}  {'/'.join(map(str, signature.n_patches))} patches  "
        f"{sum(signature.n_pairs)} pairs  {milliseconds:.0f} ms  {signer.model.label}"
    )
