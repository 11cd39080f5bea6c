"""`sceneprint serve` and `work`: the service and its workers."""

from __future__ import annotations

import argparse
import gc
import logging
import signal
import threading

from sceneprint.cli import whole_number
from sceneprint.cli.options import add_data_option, settings_of


def add_serve(command: argparse.ArgumentParser) -> None:
    """Add the options of `sceneprint serve`."""
    add_data_option(command)
    command.add_argument(
        "--host", metavar="ADDRESS",
        help="address to listen on (default: 127.0.0.1, this machine only)",
    )  # fmt: skip
    command.add_argument(
        "--port", type=whole_number, metavar="N",
        help="port to listen on (default: 8008); 0 selects a free port and prints it",
    )  # fmt: skip
    add_workers_option(command)
    command.set_defaults(run=run_serve)


def add_workers_option(command: argparse.ArgumentParser) -> None:
    """Add `--workers`."""
    command.add_argument(
        "--workers", type=whole_number, metavar="N",
        help="number of worker processes (default: number of processors)",
    )  # fmt: skip


def run_serve(options: argparse.Namespace) -> int:
    """Run the HTTP service and its workers. No configuration is required; every option can also be
    set in the environment (SCENEPRINT_HOST, _PORT, _WORKERS, _DATA_DIR).
    """
    gc.disable()  # skip collection during imports, to start faster
    from sceneprint.process import log_as_json
    from service.server import run as serve

    settings = settings_of(options)
    log_as_json()
    stop = threading.Event()
    failures: list[Exception] = []

    def work(read_only: bool) -> None:
        try:
            from sceneprint.cli.preparation import prepare_presets
            from worker.supervisor import Supervisor

            prepare_presets(settings, logging.getLogger(__name__).info, stop=stop)
            if not (read_only or stop.is_set()):
                supervisor = Supervisor(settings)
                supervisor.start()
                supervisor.watch(stop)
        except Exception as error:  # stop the service, which must not run without workers
            failures.append(error)
            signal.pthread_kill(threading.main_thread().ident or 0, signal.SIGTERM)

    threads: list[threading.Thread] = []

    def ready(url: str, read_only: bool) -> None:
        # The service responds while the thread compiles kernels and then starts workers.
        threads.append(threading.Thread(target=work, args=(read_only,), name="supervisor"))
        threads[0].start()
        print(f"sceneprint: serving {url}\nsceneprint: dashboard {url}/dashboard", flush=True)

    # uvicorn handles SIGINT and SIGTERM while it runs; this handles SIGTERM before and after.
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        serve(settings, ready)
    except KeyboardInterrupt:
        pass
    finally:
        stop.set()
        for thread in threads:
            thread.join()
    if failures:
        raise failures[0]
    return 0


# `sceneprint work`: workers without a service, on the same store.


def add_work(command: argparse.ArgumentParser) -> None:
    """Add the options of `sceneprint work`."""
    add_data_option(command)
    add_workers_option(command)
    command.set_defaults(run=run_work)


def run_work(options: argparse.Namespace) -> int:
    """Run worker processes for a service that uses the same store."""
    from sceneprint.atomic_files import warn_if_public
    from sceneprint.cli.preparation import prepare_presets
    from sceneprint.engine.context import require_writable
    from sceneprint.process import log_as_json
    from worker.supervisor import run as work

    settings = settings_of(options)
    log_as_json()
    warn_if_public(settings.data_dir)
    require_writable(settings)  # report errors once, instead of in each worker
    prepare_presets(settings, logging.getLogger(__name__).info)
    work(settings)
    return 0
