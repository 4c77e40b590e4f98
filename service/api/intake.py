"""From a request with a cloud to a committed job: the part that every route which takes one shares."""

from __future__ import annotations

from collections import Counter
from collections.abc import Awaitable, Mapping, Sequence
from pathlib import PurePosixPath, PureWindowsPath
from typing import TypeVar

from starlette.requests import Request

from straightpcf.points.errors import InvalidOptions, InvalidRequest, NotFound
from straightpcf.points.formats import format_named
from straightpcf.points.options import DenoiseOptions
from straightpcf.service.api.body import declared_size, receive_upload
from straightpcf.service.engine import Engine, JobRequest
from straightpcf.service.jobs.record import JobRecord

__all__ = ["Coming", "checked_key", "file_name", "flag", "take_job"]

OPTION_FIELDS = frozenset({"iterations", "seed", "strength", "normals"})
KNOWN_FIELDS = OPTION_FIELDS | {"format", "filename"}
MAX_NAME_LENGTH = 120
MAX_KEY_LENGTH = 255

Fields = Mapping[str, str]
# What an upload has made: the job, whether it is new and, of a form, every field that came with it.
_Taken = TypeVar("_Taken", tuple[JobRecord, bool], tuple[JobRecord, bool, Fields])


class Coming:
    """Know the jobs whose files are on their way, by whichever transport: one that is deleted meanwhile is not to be.

    Who cancels an upload deletes its job over another connection, and the rest of the file may still lie in buffers.
    """

    def __init__(self, engine: Engine) -> None:
        self._engine = engine
        self._jobs: dict[object, tuple[str, str]] = {}  # owner and id, by upload

    async def take(self, owner: str, id: str | None, taking: Awaitable[_Taken]) -> _Taken:
        """Return what an upload makes; raises NotFound where its job is deleted meanwhile."""
        upload = object()
        if id is not None:
            self._jobs[upload] = (owner, id)
        try:
            taken = await taking
            record, created = taken[0], taken[1]
            if created and id is not None and upload not in self._jobs:
                await self._engine.delete(record.id, owner=owner)
                raise NotFound(f"job {record.id} was deleted while its file was on its way")
        finally:
            self._jobs.pop(upload, None)
        return taken

    async def delete(self, owner: str, id: str) -> None:
        """Delete a job, and let none of its uploads make it; raises NotFound where there is neither."""
        uploads = [upload for upload, job in self._jobs.items() if job == (owner, id)]
        for upload in uploads:
            del self._jobs[upload]
        try:
            await self._engine.delete(id, owner=owner)
        except NotFound:
            if not uploads:
                raise


async def take_job(
    request: Request, owner: str, *, endpoint: str, id: str | None = None, more_fields: frozenset[str] = frozenset()
) -> tuple[JobRecord, bool, Fields]:
    """Receive the body and commit the job; return it, whether it is new, and every field that came with it.

    Raises NotFound where the job is deleted meanwhile.
    """
    coming: Coming = request.app.state.coming
    return await coming.take(owner, id, _take(request, owner, endpoint, id, more_fields))


async def _take(
    request: Request, owner: str, endpoint: str, id: str | None, more_fields: frozenset[str]
) -> tuple[JobRecord, bool, Fields]:
    engine: Engine = request.app.state.engine
    key = checked_key(request.headers.getlist("idempotency-key"))
    await engine.check_room(size=declared_size(request), owner=owner, id=id, idempotency_key=key)
    query = request.query_params
    _check_once([name for name, _ in query.multi_items()])  # before the body, so that it need not be read
    _parse_fields(query, more_fields)
    with engine.upload() as source:
        upload = await receive_upload(request, source)
        _check_once([*query, *upload.fields])
        fields = {**query, **upload.fields}
        options, format = _parse_fields(fields, more_fields)
        wanted = JobRequest(
            options=options,
            name=file_name(fields.get("filename") or request.path_params.get("filename") or upload.name),
            format=format,
            owner=owner,
            id=id,
            idempotency_key=key,
            endpoint=endpoint,
            traceparent=request.headers.get("traceparent"),
        )
        record, created = await engine.submit(source, wanted)
    return record, created, fields


def flag(fields: Mapping[str, str], name: str) -> bool:
    """Read a yes or no; raises InvalidOptions."""
    text = fields.get(name, "false").strip().lower()
    if text not in ("true", "false", "1", "0"):
        raise InvalidOptions(f"{name} is {text[:40]!r}; it must be true or false")
    return text in ("true", "1")


def _check_once(names: Sequence[str]) -> None:
    if len(set(names)) < len(names):
        name, times = Counter(names).most_common(1)[0]
        raise InvalidOptions(f"{name[:40]!r} is said {times} times; which one is meant?")


def _parse_fields(fields: Mapping[str, str], more: frozenset[str]) -> tuple[DenoiseOptions, str | None]:
    if unknown := set(fields) - KNOWN_FIELDS - more:
        raise InvalidOptions(f"{min(unknown)[:40]!r} is no option; known: {', '.join(sorted(KNOWN_FIELDS | more))}")
    options = DenoiseOptions.parse(**{name: fields[name] for name in OPTION_FIELDS & set(fields)})
    for name in more & set(fields):
        flag(fields, name)
    if format := fields.get("format"):
        format_named(format)
    return options, format or None


def checked_key(keys: Sequence[str]) -> str | None:
    """Return the idempotency key among all that a request says; raises InvalidRequest where it is none, or two are."""
    if len(keys) > 1:
        raise InvalidRequest(f"Idempotency-Key is said {len(keys)} times; which one is meant?")
    key = keys[0] if keys else None
    if key is not None and (not 0 < len(key) <= MAX_KEY_LENGTH or not key.isprintable()):
        raise InvalidRequest(f"Idempotency-Key must be 1 to {MAX_KEY_LENGTH} printable characters, it has {len(key)}")
    return key


def file_name(name: str | None) -> str | None:
    """Keep the last part of what the client calls the file; it names a format and a download, never a path here."""
    if name is None:
        return None
    last = PurePosixPath(PureWindowsPath(name).name).name
    return "".join(char for char in last if char.isprintable())[-MAX_NAME_LENGTH:] or None
