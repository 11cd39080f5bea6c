"""Publishing a generation: what is new is appended, and now and then all is made anew.

Every file is durable before the manifest that names it, and the manifest comes last: a builder
killed at any moment leaves the generation before, and files that the next builder removes.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import suppress
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sceneprint.errors import DamagedIndex
from sceneprint.index.coarse import Coarse, train_coarse, write_coarse
from sceneprint.index.codes import SAMPLE, Code, draw, fit_code, write_code
from sceneprint.index.drafts import Draft, append, remaining
from sceneprint.index.files import building, is_ours, put
from sceneprint.index.generations import Generation, newest
from sceneprint.index.manifests import Manifest, Recall, manifests, read_manifest, write_manifest
from sceneprint.index.recall import measure_recall, still_holds
from sceneprint.index.segments import BLOCK_BYTES, Block, blocks_of, gather
from sceneprint.types import Floats32

#: A code is fitted anew when the map has this many times the frames that it had at the last fit.
GROWTH = 2
#: Frames up to which a code is fitted anew where nothing of a deleted one may be left.
REFITTED = 4 * SAMPLE


def publish(
    folder: Path,
    *,
    model_id: str,
    revision: int,
    blocks: Iterable[Block],
    previous: Generation | None,
    drop: frozenset[int] = frozenset(),
    anchor: str = "",
    seed: int = 0,
    clean: bool = False,
) -> Generation | None:
    """Publish the generation that follows `previous`.

    One process builds in a folder at a time. The two newest generations are kept, and files of
    older ones removed; readers that hold them go on undisturbed.

    Parameters
    ----------
    folder : of the map; made if need be
    model_id : of the model that signed the frames
    revision : of the map, up to which `blocks` and `previous` hold its frames
    blocks : keys (n,) int64 and signatures (n, D) uint8 of the frames that are not in `previous`;
        a key that is there replaces the signature there. It is read once, and block by block.
    previous : the newest generation of the folder, or None to build from nothing
    drop : keys of frames that are no longer in the map
    anchor : of the database's state; kept as it is, for whoever opens the generation to check
    seed : of the rows that the code is fitted on, and of the frames that recall is measured by
    clean : leave no file that has a byte of a frame that is no longer there: the generation
        before is not kept

    Returns
    -------
    the generation, open; None where somebody else is building, or `previous` is no longer the
    newest of the folder: then open the newest and try again

    Raises
    ------
    ValueError : blocks that are none, that have a key twice, or signatures of another model or
        length than `previous`; no frames and no `previous`.
    OSError : a file cannot be written; the generation before remains.
    """
    if previous is not None and previous.model_id != model_id:
        raise ValueError(f"frames of model {model_id} appended to those of {previous.model_id}")
    with building(folder) as mine:
        if not mine or _overtaken(folder, previous):
            return None
        listed = manifests(folder)
        kept = remaining(folder, previous, drop, clean=clean)
        draft = append(folder, kept, blocks, drop)
        # of few frames, their mean is what each of them looks like
        anew = clean and len(draft.rows) <= REFITTED
        code, coarse, fitted_on = _codes(draft, None if anew else previous, seed)
        generation = Generation(
            number=listed[0][0] + 1 if listed else 1,
            revision=revision,
            model_id=model_id,
            code=code,
            fitted_on=fitted_on,
            anchor=anchor,
            segments=draft.segments,
            rows=draft.rows,
            keys=draft.keys,
            coarse=coarse,
        )
        own = _write(folder, generation, _recall(listed, previous, generation, seed))
        if previous is not None:  # known to be sound, whatever lies between
            listed = [each for each in listed if each[0] == previous.number]
        _clean(folder, {own, *(path for _, path in listed[: 0 if clean else 1])})
        return generation


def clear(folder: Path, but: int | None = None) -> bool:
    """Remove all generations of a folder, or all but one; False where somebody is building there.

    Readers that hold them go on undisturbed.
    """
    with building(folder) as mine:
        if mine:
            _clean(folder, {path for number, path in manifests(folder) if number == but})
        return mine


def _overtaken(folder: Path, previous: Generation | None) -> bool:
    """Whether a generation was published, or the folder emptied, since `previous` was opened."""
    if previous is None:
        return False
    found = newest(folder, previous.model_id, previous.dimension, known=previous)
    return found is None or found.number != previous.number


def _codes(draft: Draft, previous: Generation | None, seed: int) -> tuple[Code, Coarse, int]:
    """Code, codes, and the number of frames that the code was fitted on."""
    n = len(draft.rows)
    if previous is not None and n < GROWTH * previous.fitted_on:
        new = _encoded(previous.code, draft, draft.rows[len(draft.kept) :])
        return previous.code, previous.coarse.appended(draft.kept, new), previous.fitted_on
    if n == 0:
        raise ValueError("a generation of no frames that follows none")
    sample = gather(draft.segments, draft.rows[draw(n, SAMPLE, seed)])
    code = fit_code(sample, seed)
    coarse = train_coarse(code.encode(sample))
    return code, coarse.appended(draft.kept[:0], _encoded(code, draft, draft.rows)), n


def _recall(
    listed: list[tuple[int, Path]], previous: Generation | None, generation: Generation, seed: int
) -> Recall:
    """As measured of the generation before, while that stands for this one; else measured."""
    if previous is not None and previous.code is generation.code:
        for _, path in [each for each in listed if each[0] == previous.number]:
            with suppress(DamagedIndex):  # since it was opened: it is measured anew
                known = read_manifest(path).recall
                if known is not None and still_holds(known, len(generation)):
                    return known
    return measure_recall(generation, seed)


def _encoded(code: Code, draft: Draft, rows: NDArray[np.int64]) -> Iterator[Floats32]:
    for some in blocks_of(rows, len(code.mean), BLOCK_BYTES):
        yield code.encode(gather(draft.segments, some))


def _write(folder: Path, generation: Generation, recall: Recall) -> Path:
    """Write all but the segments, which are there, and the manifest last."""
    others = {
        "rows": generation.rows.astype("<i8").tobytes(),
        "faiss": write_coarse(generation.coarse),
        "code": write_code(generation.code),
    }
    written = [(put(folder, data, kind), len(data)) for kind, data in others.items()]
    manifest = Manifest(
        number=generation.number,
        revision=generation.revision,
        model_id=generation.model_id,
        dimension=generation.dimension,
        code_id=generation.code.id,
        fitted_on=generation.fitted_on,
        anchor=generation.anchor,
        recall=recall,
        files=(*((each.name, each.size) for each in generation.segments), *written),
    )
    return write_manifest(folder, manifest)


def _clean(folder: Path, kept: set[Path]) -> None:
    """Remove all manifests but some, and every file that none of these needs."""
    needed = {name for path in kept for name, _ in _files(path)}
    for _, path in manifests(folder):
        if path not in kept:  # before its files: a manifest should not promise what is gone
            path.unlink(missing_ok=True)
    for path in folder.iterdir():
        if is_ours(path.name) and path.name not in needed:
            path.unlink(missing_ok=True)


def _files(path: Path) -> tuple[tuple[str, int], ...]:
    try:
        return read_manifest(path).files
    except DamagedIndex:  # it was not sound, and nothing will be read by it
        return ()
