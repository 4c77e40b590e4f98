"""The server's end of one worker process: start it, hand it a job, notice when it dies."""

from __future__ import annotations

import asyncio
import atexit
import multiprocessing
from typing import Any

from straightpcf.model.children import signals_kept
from straightpcf.points.errors import ERRORS_BY_CODE, InternalError
from straightpcf.service.backends.base import FileJob, FileReport, FilesUnusable, Listener, WorkerDied
from straightpcf.service.backends.worker import (
    SERVERS_OWN,
    Cancel,
    Done,
    Failed,
    Preview,
    Progress,
    Ready,
    Unusable,
    WorkerSpec,
    run_worker,
)

__all__ = ["WorkerProcess"]

# A worker that reads or writes a large file does not look at its pipe; after this it is replaced.
CANCEL_PATIENCE_SECONDS = 0.8
# A process closes its pipe a moment before it can be reaped; the loop may be held up for so long.
REAP_SECONDS = 0.01

_SPAWN = multiprocessing.get_context("spawn")  # a forked CUDA context is broken, and a fork copies our sockets


class WorkerProcess:
    """Own one child process and its pipe; every method runs on the event loop and none of them blocks it."""

    def __init__(self, spec: WorkerSpec) -> None:
        self._loop = asyncio.get_running_loop()
        self._pipe, theirs = _SPAWN.Pipe()
        self._process = _SPAWN.Process(
            target=run_worker, args=(theirs, spec), daemon=True, name=f"straightpcf-worker-{spec.device}"
        )
        with signals_kept(SERVERS_OWN):  # until `run_worker` sees to them
            self._process.start()
        # Where a server ends without `stop`, multiprocessing would ask with SIGTERM, and wait for ever.
        atexit.register(self._process.kill)
        theirs.close()
        self._loop.add_reader(self._pipe.fileno(), self._read)
        self.ready: asyncio.Future[str] = self._loop.create_future()
        self.died: asyncio.Future[None] = self._loop.create_future()
        self._job: FileJob | None = None
        self._answer: asyncio.Future[FileReport] | None = None
        self._listener: Listener | None = None

    @property
    def alive(self) -> bool:
        """Tell whether jobs may still be handed over."""
        return not self.died.done()

    @property
    def pid(self) -> int | None:
        """Name the process."""
        return self._process.pid

    async def run(self, job: FileJob, listener: Listener) -> FileReport:
        """Run one job at a time; raises its error, WorkerDied or FilesUnusable.

        When cancelled, wait until the worker has let go.
        """
        answer: asyncio.Future[FileReport] = self._loop.create_future()
        self._job, self._answer, self._listener = job, answer, listener
        try:
            self._send(job)
            return await asyncio.shield(answer)
        except asyncio.CancelledError:
            self._listener = None
            self._send(Cancel(job.id))
            await asyncio.wait([answer], timeout=CANCEL_PATIENCE_SECONDS)
            raise
        finally:
            if not answer.done():  # cancelled, and too busy to notice: of no use until it ends
                answer.cancel()
                self._bury()
            elif not answer.cancelled():
                answer.exception()  # seen, whoever wants it
            self._job = self._answer = self._listener = None

    async def stop(self, *, patience_seconds: float) -> None:
        """Ask the process to end, and make it after a while, or at once if it is still loading; reaps it."""
        if self.ready.done():
            self._send(None)
            await asyncio.to_thread(self._process.join, patience_seconds)
        if self._process.is_alive():
            self._process.kill()
            await asyncio.to_thread(self._process.join)
        self._bury()

    def _send(self, message: Any) -> None:
        if not self.alive:
            return
        try:
            self._pipe.send(message)
        except OSError:
            self._bury()

    def _read(self) -> None:
        try:
            while self.alive and self._pipe.poll():
                self._take(self._pipe.recv())
        except (EOFError, OSError):
            self._process.join(REAP_SECONDS)
            self._bury()

    def _take(self, message: Any) -> None:
        match message:
            case Ready(device):
                self.ready.set_result(device)
            case Failed(None, code, text):
                self.ready.set_exception(ERRORS_BY_CODE.get(code, InternalError)(text))
            case Progress(job_id, fraction, iteration) if self._concerns(job_id) and self._listener is not None:
                self._listener.on_progress(fraction, iteration)
            case Preview(job_id, iteration, indices, xyz) if self._concerns(job_id) and self._listener is not None:
                self._listener.on_preview(iteration, indices, xyz)
            case Done(job_id, report) if self._concerns(job_id) and self._answer is not None:
                self._answer.set_result(report)
            case Failed(job_id, code, text) if self._concerns(job_id) and self._answer is not None:
                self._answer.set_exception(ERRORS_BY_CODE.get(code, InternalError)(text))
            case Unusable(job_id, text) if self._concerns(job_id) and self._answer is not None:
                self._answer.set_exception(FilesUnusable(text))

    def _concerns(self, job_id: str | None) -> bool:
        return self._job is not None and self._job.id == job_id and self._answer is not None and not self._answer.done()

    def _bury(self) -> None:
        if not self.alive:
            return
        self._loop.remove_reader(self._pipe.fileno())
        self._pipe.close()
        how = self._end()
        self.died.set_result(None)
        if not self.ready.done():
            self.ready.set_exception(WorkerDied(f"worker {self.pid} {how} before it was ready"))
        if self._answer is not None and not self._answer.done():
            self._answer.set_exception(WorkerDied(f"worker {self.pid} {how} during job {self._job and self._job.id}"))

    def _end(self) -> str:
        """Make sure that the process ends, its end of the pipe being gone or unwanted; say how it ended by itself."""
        code = self._process.exitcode
        self._process.kill()
        atexit.unregister(self._process.kill)
        if code is None:
            return "was ended"
        return f"ended with exit code {code}" if code >= 0 else f"was killed by signal {-code}"
