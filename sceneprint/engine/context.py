"""Context of an engine: settings, store, wakeup, signers, readers and query log."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass

from threadpoolctl import threadpool_limits

from sceneprint.decoders import Decoders, LocalDecoders
from sceneprint.decoders.pool import DecoderPool
from sceneprint.engine.results.query_log import QueryLog
from sceneprint.engine.search.index_place import IndexPlace
from sceneprint.engine.search.retrieval import Readers
from sceneprint.engine.signers import Signers
from sceneprint.geometry.kernel import Cores
from sceneprint.settings import Settings
from sceneprint.store import Store, open_store
from sceneprint.store.answer_files import open_answers
from sceneprint.store.database_errors import open_patiently
from sceneprint.store.wakeup import Notices, Wakeup


@dataclass(frozen=True, eq=False)
class Context:
    """Objects that the parts of an engine share in one process; safe to share between threads.

    Parameters
    ----------
    bell : signal that wakes workers waiting for jobs
    indexes : indexes of all maps
    cores : allocation of processor cores to queries
    """

    settings: Settings
    store: Store
    bell: Wakeup
    signers: Signers
    indexes: IndexPlace
    readers: Readers
    query_log: QueryLog
    cores: Cores


@contextmanager
def open_context(
    settings: Settings, patience_s: float = 0.0, may_go_on: Callable[[float], bool] | None = None
) -> Iterator[Context]:
    """Yield an open context, and close it at the end.

    Parameters
    ----------
    patience_s, may_go_on : limits of the wait for an unreachable database; see `open_patiently`

    Raises
    ------
    UnusableStore, NewerSchema : If the store cannot be opened.
    """
    with ExitStack() as stack:
        yield open_patiently(lambda: _enter(stack, settings), patience_s, may_go_on)


def require_writable(settings: Settings) -> None:
    """Check that a service or a worker could start with these settings.

    Raises
    ------
    UnusableStore, NewerSchema : If the store cannot be opened or shared with other processes.
    ReadOnlyStore : If the store cannot be written to.
    """
    with closing(
        open_patiently(lambda: open_store(settings.database, settings.served_blobs))
    ) as store:
        store.database.require_writable()


def _enter(stack: ExitStack, settings: Settings) -> Context:
    decoders: Decoders = LocalDecoders(settings.concurrent_requests)
    if settings.decoders > 0:
        decoders = DecoderPool(
            settings.decoders,
            settings.decoder_memory_bytes,
            settings.decoder_timeout_s,
        )
    with ExitStack() as opened:  # close the objects if a later step fails
        store = open_store(
            settings.database, settings.blobs, settings.geometry_cache_bytes, decoders
        )
        opened.callback(store.close)
        server = not store.database.is_sqlite
        bell = Notices(store.database) if server else Wakeup(settings.bell_dir)
        opened.callback(bell.close)
        # one BLAS thread: requests run in parallel, and the order of sums is reproducible
        opened.enter_context(threadpool_limits(1))
        cores = opened.enter_context(closing(Cores(settings.query_cores)))
        answers = open_answers(store.blobs, settings.query_dir)
        query_log = opened.enter_context(closing(QueryLog(store, answers, settings)))
        indexes = opened.enter_context(closing(IndexPlace(store, settings)))
        signers = Signers(store.database, settings.cache_dir)
        readers = Readers(signers, indexes)
        stack.push(opened.pop_all())
    return Context(settings, store, bell, signers, indexes, readers, query_log, cores)
