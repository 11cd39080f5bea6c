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

from sceneprint.cli.signer import add_model_options, open_for
from sceneprint.datasets import FrameReference, find_sequences
from sceneprint.errors import DatasetError, FrameError
from sceneprint.pipeline import Signature, Signer, sign
from sceneprint.settings import Settings


def add_to(commands: Any) -> None:
    """Describe the command to the parser."""
    command = commands.add_parser(
        "sign",
        help="sign depth frames",
        description="Sign every frame of the given files and folders (7-Scenes, TUM RGB-D or "
        "plain depth images, with an intrinsics.json beside them or above).",
    )
    command.add_argument("paths", nargs="+", type=Path, metavar="PATH")
    add_model_options(command)
    command.add_argument(
        "--out",
        type=Path,
        metavar="DIR",
        help="write one FRAME.sig per frame (the signature's bytes) and signatures.json",
    )
    command.set_defaults(run=run)


@dataclass(frozen=True, eq=False)
class Signed:
    """One frame's outcome: a signature with its time, or the reason why there is none."""

    reference: FrameReference
    name: str
    signature: Signature | None
    milliseconds: float
    reason: str = ""


def named_frames(paths: list[Path]) -> list[tuple[str, FrameReference]]:
    """All frames below the paths, under names that are unique among them.

    Raises
    ------
    DatasetError : nothing is found at a path, or one path was given twice.
    """
    frames: dict[str, FrameReference] = {}
    for path in paths:
        prefix = f"{path.resolve().name}/" if len(paths) > 1 else ""
        for sequence in find_sequences(path):
            for reference in sequence.frames:
                known = reference.name.startswith(prefix)
                name = reference.name if known else prefix + reference.name
                if name in frames:
                    raise DatasetError(
                        f"{path}: {name} is already the name of {frames[name].path}. "
                        "Sign the two in separate runs."
                    )
                frames[name] = reference
    return list(frames.items())


def run(options: argparse.Namespace) -> int:
    """Sign; returns 2 where a frame could not be signed."""
    frames = named_frames(options.paths)
    if options.out is not None:
        options.out.mkdir(parents=True, exist_ok=True)
    signer = open_for(options, Settings())
    done: list[Signed] = []
    with tqdm(frames, desc="sign", unit="frame", disable=None) as bar:
        for name, reference in bar:
            one = _sign(name, reference, signer)
            done.append(one)
            bar.write(_line(one, signer))
            if options.out is not None and one.signature is not None:
                _write_signature(options.out, one.name, one.signature)
    if options.out is not None:
        _write_index(options.out, done, signer)
    return _report(done, signer)


def _sign(name: str, reference: FrameReference, signer: Signer) -> Signed:
    try:
        frame = reference.read()
        start = time.perf_counter()
        signature = sign(frame, signer)
        return Signed(reference, name, signature, 1e3 * (time.perf_counter() - start))
    except FrameError as error:
        return Signed(reference, name, None, 0.0, str(error))


def _line(one: Signed, signer: Signer) -> str:
    if one.signature is None:
        return f"{one.name}  NOT SIGNED  {one.reason}"
    patches = "/".join(map(str, one.signature.n_patches))
    return (
        f"{one.name}  {patches} patches  {sum(one.signature.n_pairs)} pairs  "
        f"{one.milliseconds:.0f} ms  {signer.model.label}"
    )


def _write_signature(folder: Path, name: str, signature: Signature) -> None:
    path = folder / f"{name}.sig"
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(path.name + ".partial")
    partial.write_bytes(signature.vector.tobytes())
    partial.replace(path)


def _write_index(folder: Path, done: list[Signed], signer: Signer) -> None:
    model = signer.model
    index = {
        "model": {
            "name": model.name,
            "id": model.id,
            "signature_bytes": model.signature_bytes,
            "unrelated_distance": model.unrelated_distance,
        },
        "frames": [_entry(one) for one in done],
    }
    partial = folder / "signatures.json.partial"
    partial.write_text(json.dumps(index, indent=1) + "\n")
    partial.replace(folder / "signatures.json")


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
        print(f"{failed} could not be signed; their lines above say why", file=sys.stderr)
    return 2 if failed else 0
