"""`sceneprint serve`: the service and its workers in one go."""

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
        help="port to listen on (default: 8008); 0 picks a free port and prints it",
    )  # fmt: skip
    add_workers_option(command)
    command.set_defaults(run=run_serve)


def add_workers_option(command: argparse.ArgumentParser) -> None:
    """`--workers`."""
    command.add_argument(
        "--workers", type=whole_number, metavar="N",
        help="number of worker processes (default: processors)",
    )  # fmt: skip


def run_serve(options: argparse.Namespace) -> int:
    """Run the HTTP service and its workers. It needs no configuration; you can also set every
    option in the environment (SCENEPRINT_HOST, _PORT, _WORKERS, _DATA_DIR).
    """
    gc.disable()  # until all is imported: a twelfth of the start would go to it
    from sceneprint.process import log_as_json
    from service.server import run as serve

    settings = settings_of(options)
    log_as_json()  # from the first line on
    stop = threading.Event()
    failures: list[Exception] = []

    def work(read_only: bool) -> None:
        try:
            from sceneprint.cli.preparation import prepare_presets
            from worker.supervisor import Supervisor

            prepare_presets(settings, logging.getLogger(__name__).info, stop=stop)
            if not (read_only or stop.is_set()):  # there would be nothing for workers to do
                supervisor = Supervisor(settings)
                supervisor.start()
                supervisor.watch(stop)
        except Exception as error:  # a service without its workers must not go on
            failures.append(error)
            signal.pthread_kill(threading.main_thread().ident or 0, signal.SIGTERM)

    threads: list[threading.Thread] = []

    def ready(url: str, read_only: bool) -> None:
        # the service answers while kernels are compiled; workers begin once they are
        threads.append(threading.Thread(target=work, args=(read_only,), name="supervisor"))
        threads[0].start()
        print(f"sceneprint: serving {url}\nsceneprint: dashboard {url}/dashboard", flush=True)

    # uvicorn handles both signals while it runs; before and after, leave by the same way out
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        serve(settings, ready)
    except KeyboardInterrupt:
        pass  # the ordinary end
    finally:
        stop.set()
        for thread in threads:
            thread.join()
    if failures:
        raise failures[0]
    return 0


# `sceneprint work`: workers alone, beside a service that runs elsewhere on the same store.


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
    log_as_json()  # from the first line on
    warn_if_public(settings.data_dir)
    require_writable(settings)  # what is wrong is said once, and not by every worker
    prepare_presets(settings, logging.getLogger(__name__).info)
    work(settings)
    return 0
