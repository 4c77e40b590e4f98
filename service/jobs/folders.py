"""The files of jobs: uploads on their way in, one folder per job, and a lock per server that tells whether it lives."""

from __future__ import annotations

import errno
import fcntl
import hashlib
import os
import re
import shutil
import tempfile
import time
import uuid
from collections.abc import Collection, Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO

from straightpcf.service.jobs.full_disk import full_disk_as_spool_full

__all__ = ["INPUT", "JobFolders", "digest_of"]

INPUT = "input"
# Other users of the machine have no key either, and the folders around may have been there, and theirs to look into.
_MODE, _FILE_MODE = 0o700, 0o600
_ORPHAN_SECONDS = 3600.0  # an upload, folder or lock that nobody owns is given up after this
# What is called otherwise is no server's: a data directory may be a folder that had a `jobs` of its own.
_OURS = re.compile(r"[0-9a-f]{32}")  # folders and locks
_UPLOAD = re.compile(r"tmp\w{8}")  # as mkstemp calls them
_ANY = re.compile(r".*", re.DOTALL)


class JobFolders:
    """Own `<data_dir>/jobs`, `incoming` and `servers`; several servers of one user may share them."""

    def __init__(self, data_dir: Path) -> None:
        self._jobs, self._incoming, self._servers = (data_dir / name for name in ("jobs", "incoming", "servers"))
        data_dir.mkdir(mode=_MODE, parents=True, exist_ok=True)
        for folder in (self._jobs, self._incoming, self._servers):
            folder.mkdir(mode=_MODE, exist_ok=True)
        self._check_moves()
        self.server = uuid.uuid4().hex
        self._lock_path(self.server).touch(mode=_FILE_MODE)
        self._lock: IO[bytes] = self._lock_path(self.server).open("wb")
        fcntl.flock(self._lock, fcntl.LOCK_EX)

    def _check_moves(self) -> None:
        """Raise OSError where a file cannot be moved from `incoming` to `jobs`: one of them is mounted, or a link."""
        handle, upload = tempfile.mkstemp(dir=self._incoming)
        os.close(handle)
        try:
            moved = Path(upload).replace(self.path(Path(upload).name))
        except OSError as exc:
            Path(upload).unlink()
            if exc.errno != errno.EXDEV:
                raise
            where = f"{self._jobs} and {self._incoming} are not on one disk"
            raise OSError(exc.errno, f"{where}: mount or link their folder, not one of them") from exc
        moved.unlink()

    def close(self) -> None:
        """Let go of this server's lock."""
        self._lock_path(self.server).unlink(missing_ok=True)
        self._lock.close()

    @contextmanager
    def upload(self) -> Iterator[Path]:
        """Lend the path of a file to be; whatever is still there at the end is removed.

        Raises SpoolFull where the disk is full, also while the file is filled.
        """
        with full_disk_as_spool_full():
            handle, name = tempfile.mkstemp(dir=self._incoming)
            try:
                fcntl.flock(handle, fcntl.LOCK_EX)  # for as long as somebody may be sending, however slowly
                yield Path(name)
            finally:
                os.close(handle)  # first: a folder that is read-only by now lets nothing be removed
                Path(name).unlink(missing_ok=True)

    def path(self, folder: str) -> Path:
        """Return where a job's folder is."""
        return self._jobs / folder

    def adopt(self, upload: Path, name: str) -> None:
        """Make an upload the input of a job that is about to be committed, durably."""
        folder = self.path(name)
        folder.mkdir(mode=_MODE)
        with upload.open("rb") as file:
            os.fsync(file.fileno())
        upload.replace(folder / INPUT)
        for path in (folder, self._jobs):
            _sync(path)

    def give_back(self, name: str, upload: Path) -> None:
        """Undo `adopt`, as far as it came: what failed may be tried again."""
        with suppress(OSError):  # what made it fail is raised already
            (self.path(name) / INPUT).replace(upload)
        self.remove(name)

    def remove(self, folder: str) -> None:
        """Remove a job's files."""
        shutil.rmtree(self.path(folder), ignore_errors=True)

    def remove_files(self, folder: str, names: Iterable[str]) -> None:
        """Remove some of a job's files, where they are there."""
        for name in names:
            (self.path(folder) / name).unlink(missing_ok=True)

    def job_bytes(self, folder: str) -> int:
        """Return how large a job's files are."""
        return _bytes_in(self.path(folder))

    def incoming_bytes(self) -> int:
        """Return how large all uploads on their way in are."""
        return _bytes_in(self._incoming, _UPLOAD)

    def used_bytes(self) -> int:
        """Return how large the files of all jobs are, and of all uploads on their way in."""
        return _bytes_in(self._jobs, _OURS) + self.incoming_bytes()

    def free_bytes(self) -> int:
        """Return how much room the disk has."""
        return shutil.disk_usage(self._jobs).free

    def dead_servers(self, servers: Collection[str]) -> list[str]:
        """Return those servers whose lock nobody holds any more; remove their locks, and old ones of any other."""
        dead = []
        for server in {*servers, *self._old_locks()}:
            path = self._lock_path(server)
            if _is_locked(path):
                continue  # it lives
            with suppress(OSError):  # it is dead all the same
                path.unlink()
            if server in servers:
                dead.append(server)
        return dead

    def drop_uploads(self) -> None:
        """Remove uploads that nobody finished; raises OSError of one that stays once the others are gone."""
        fault: OSError | None = None
        for upload in _old_in(self._incoming):
            if _UPLOAD.fullmatch(upload.name) and upload.is_file() and not _is_locked(upload):
                try:
                    upload.unlink(missing_ok=True)
                except OSError as exc:
                    fault = exc
        if fault is not None:
            raise fault

    def orphans(self) -> list[str]:
        """Name job folders that are old enough to have been committed."""
        return [folder.name for folder in _old_in(self._jobs) if _OURS.fullmatch(folder.name)]

    def _old_locks(self) -> list[str]:
        """Name the servers that began so long ago that they hold their locks if they live."""
        old = _old_in(self._servers)
        return [path.stem for path in old if path.suffix == ".lock" and _OURS.fullmatch(path.stem)]

    def _lock_path(self, server: str) -> Path:
        return self._servers / f"{server}.lock"


def digest_of(path: Path) -> str:
    """Return a file's sha256 in hex."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _is_locked(path: Path) -> bool:
    try:
        with path.open("rb") as file:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except FileNotFoundError:
        return False
    except OSError:
        return True
    return False


def _old_in(folder: Path) -> list[Path]:
    before = time.time() - _ORPHAN_SECONDS
    old = []
    for path in folder.iterdir():
        with suppress(FileNotFoundError):
            if path.stat().st_mtime < before:
                old.append(path)
    return old


def _bytes_in(folder: Path, ours: re.Pattern[str] = _ANY) -> int:
    """Return how large the files in a folder are; ours: what is called otherwise in it does not count."""
    size, here = 0, os.fspath(folder)
    for at, folders, names in os.walk(folder):  # which passes over a folder that is removed meanwhile
        if at == here:
            folders[:] = filter(ours.fullmatch, folders)
        for name in filter(ours.fullmatch, names) if at == here else names:
            with suppress(FileNotFoundError):
                size += Path(at, name).stat().st_size
    return size


def _sync(folder: Path) -> None:
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
