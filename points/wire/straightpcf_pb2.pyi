import datetime

from google.protobuf import empty_pb2 as _empty_pb2
from google.protobuf import timestamp_pb2 as _timestamp_pb2
from google.protobuf.internal import containers as _containers
from google.protobuf.internal import enum_type_wrapper as _enum_type_wrapper
from google.protobuf import descriptor as _descriptor
from google.protobuf import message as _message
from collections.abc import Iterable as _Iterable, Mapping as _Mapping
from typing import ClassVar as _ClassVar, Optional as _Optional, Union as _Union

DESCRIPTOR: _descriptor.FileDescriptor

class JobState(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    JOB_STATE_UNSPECIFIED: _ClassVar[JobState]
    JOB_STATE_QUEUED: _ClassVar[JobState]
    JOB_STATE_STARTING: _ClassVar[JobState]
    JOB_STATE_PROCESSING: _ClassVar[JobState]
    JOB_STATE_SUCCEEDED: _ClassVar[JobState]
    JOB_STATE_FAILED: _ClassVar[JobState]
    JOB_STATE_CANCELED: _ClassVar[JobState]
    JOB_STATE_EXPIRED: _ClassVar[JobState]
JOB_STATE_UNSPECIFIED: JobState
JOB_STATE_QUEUED: JobState
JOB_STATE_STARTING: JobState
JOB_STATE_PROCESSING: JobState
JOB_STATE_SUCCEEDED: JobState
JOB_STATE_FAILED: JobState
JOB_STATE_CANCELED: JobState
JOB_STATE_EXPIRED: JobState

class DenoiseOptions(_message.Message):
    __slots__ = ("iterations", "seed", "strength", "recompute_normals")
    ITERATIONS_FIELD_NUMBER: _ClassVar[int]
    SEED_FIELD_NUMBER: _ClassVar[int]
    STRENGTH_FIELD_NUMBER: _ClassVar[int]
    RECOMPUTE_NORMALS_FIELD_NUMBER: _ClassVar[int]
    iterations: int
    seed: int
    strength: float
    recompute_normals: bool
    def __init__(self, iterations: _Optional[int] = ..., seed: _Optional[int] = ..., strength: _Optional[float] = ..., recompute_normals: _Optional[bool] = ...) -> None: ...

class JobConfig(_message.Message):
    __slots__ = ("options", "filename", "format", "id", "bytes")
    OPTIONS_FIELD_NUMBER: _ClassVar[int]
    FILENAME_FIELD_NUMBER: _ClassVar[int]
    FORMAT_FIELD_NUMBER: _ClassVar[int]
    ID_FIELD_NUMBER: _ClassVar[int]
    BYTES_FIELD_NUMBER: _ClassVar[int]
    options: DenoiseOptions
    filename: str
    format: str
    id: str
    bytes: int
    def __init__(self, options: _Optional[_Union[DenoiseOptions, _Mapping]] = ..., filename: _Optional[str] = ..., format: _Optional[str] = ..., id: _Optional[str] = ..., bytes: _Optional[int] = ...) -> None: ...

class DenoiseConfig(_message.Message):
    __slots__ = ("job", "patches", "return_file")
    JOB_FIELD_NUMBER: _ClassVar[int]
    PATCHES_FIELD_NUMBER: _ClassVar[int]
    RETURN_FILE_FIELD_NUMBER: _ClassVar[int]
    job: JobConfig
    patches: bool
    return_file: bool
    def __init__(self, job: _Optional[_Union[JobConfig, _Mapping]] = ..., patches: _Optional[bool] = ..., return_file: _Optional[bool] = ...) -> None: ...

class DenoiseRequest(_message.Message):
    __slots__ = ("config", "chunk")
    CONFIG_FIELD_NUMBER: _ClassVar[int]
    CHUNK_FIELD_NUMBER: _ClassVar[int]
    config: DenoiseConfig
    chunk: bytes
    def __init__(self, config: _Optional[_Union[DenoiseConfig, _Mapping]] = ..., chunk: _Optional[bytes] = ...) -> None: ...

class DenoiseResponse(_message.Message):
    __slots__ = ("accepted", "progress", "patch", "chunk", "summary")
    ACCEPTED_FIELD_NUMBER: _ClassVar[int]
    PROGRESS_FIELD_NUMBER: _ClassVar[int]
    PATCH_FIELD_NUMBER: _ClassVar[int]
    CHUNK_FIELD_NUMBER: _ClassVar[int]
    SUMMARY_FIELD_NUMBER: _ClassVar[int]
    accepted: Job
    progress: Progress
    patch: Patch
    chunk: bytes
    summary: Job
    def __init__(self, accepted: _Optional[_Union[Job, _Mapping]] = ..., progress: _Optional[_Union[Progress, _Mapping]] = ..., patch: _Optional[_Union[Patch, _Mapping]] = ..., chunk: _Optional[bytes] = ..., summary: _Optional[_Union[Job, _Mapping]] = ...) -> None: ...

class CreateJobRequest(_message.Message):
    __slots__ = ("config", "chunk")
    CONFIG_FIELD_NUMBER: _ClassVar[int]
    CHUNK_FIELD_NUMBER: _ClassVar[int]
    config: JobConfig
    chunk: bytes
    def __init__(self, config: _Optional[_Union[JobConfig, _Mapping]] = ..., chunk: _Optional[bytes] = ...) -> None: ...

class GetJobRequest(_message.Message):
    __slots__ = ("id", "wait_seconds")
    ID_FIELD_NUMBER: _ClassVar[int]
    WAIT_SECONDS_FIELD_NUMBER: _ClassVar[int]
    id: str
    wait_seconds: float
    def __init__(self, id: _Optional[str] = ..., wait_seconds: _Optional[float] = ...) -> None: ...

class ListJobsRequest(_message.Message):
    __slots__ = ("states", "limit", "cursor")
    STATES_FIELD_NUMBER: _ClassVar[int]
    LIMIT_FIELD_NUMBER: _ClassVar[int]
    CURSOR_FIELD_NUMBER: _ClassVar[int]
    states: _containers.RepeatedScalarFieldContainer[JobState]
    limit: int
    cursor: str
    def __init__(self, states: _Optional[_Iterable[_Union[JobState, str]]] = ..., limit: _Optional[int] = ..., cursor: _Optional[str] = ...) -> None: ...

class ListJobsResponse(_message.Message):
    __slots__ = ("jobs", "next_cursor")
    JOBS_FIELD_NUMBER: _ClassVar[int]
    NEXT_CURSOR_FIELD_NUMBER: _ClassVar[int]
    jobs: _containers.RepeatedCompositeFieldContainer[Job]
    next_cursor: str
    def __init__(self, jobs: _Optional[_Iterable[_Union[Job, _Mapping]]] = ..., next_cursor: _Optional[str] = ...) -> None: ...

class WatchJobRequest(_message.Message):
    __slots__ = ("id", "after")
    ID_FIELD_NUMBER: _ClassVar[int]
    AFTER_FIELD_NUMBER: _ClassVar[int]
    id: str
    after: int
    def __init__(self, id: _Optional[str] = ..., after: _Optional[int] = ...) -> None: ...

class CancelJobRequest(_message.Message):
    __slots__ = ("id",)
    ID_FIELD_NUMBER: _ClassVar[int]
    id: str
    def __init__(self, id: _Optional[str] = ...) -> None: ...

class DeleteJobRequest(_message.Message):
    __slots__ = ("id",)
    ID_FIELD_NUMBER: _ClassVar[int]
    id: str
    def __init__(self, id: _Optional[str] = ...) -> None: ...

class StreamPatchesRequest(_message.Message):
    __slots__ = ("id",)
    ID_FIELD_NUMBER: _ClassVar[int]
    id: str
    def __init__(self, id: _Optional[str] = ...) -> None: ...

class DownloadResultRequest(_message.Message):
    __slots__ = ("id", "offset")
    ID_FIELD_NUMBER: _ClassVar[int]
    OFFSET_FIELD_NUMBER: _ClassVar[int]
    id: str
    offset: int
    def __init__(self, id: _Optional[str] = ..., offset: _Optional[int] = ...) -> None: ...

class DownloadResultResponse(_message.Message):
    __slots__ = ("result", "chunk")
    RESULT_FIELD_NUMBER: _ClassVar[int]
    CHUNK_FIELD_NUMBER: _ClassVar[int]
    result: ResultInfo
    chunk: bytes
    def __init__(self, result: _Optional[_Union[ResultInfo, _Mapping]] = ..., chunk: _Optional[bytes] = ...) -> None: ...

class Job(_message.Message):
    __slots__ = ("id", "state", "name", "format", "options", "bytes", "points", "progress", "attempts", "position", "created_at", "started_at", "finished_at", "expires_at", "error", "result", "report")
    ID_FIELD_NUMBER: _ClassVar[int]
    STATE_FIELD_NUMBER: _ClassVar[int]
    NAME_FIELD_NUMBER: _ClassVar[int]
    FORMAT_FIELD_NUMBER: _ClassVar[int]
    OPTIONS_FIELD_NUMBER: _ClassVar[int]
    BYTES_FIELD_NUMBER: _ClassVar[int]
    POINTS_FIELD_NUMBER: _ClassVar[int]
    PROGRESS_FIELD_NUMBER: _ClassVar[int]
    ATTEMPTS_FIELD_NUMBER: _ClassVar[int]
    POSITION_FIELD_NUMBER: _ClassVar[int]
    CREATED_AT_FIELD_NUMBER: _ClassVar[int]
    STARTED_AT_FIELD_NUMBER: _ClassVar[int]
    FINISHED_AT_FIELD_NUMBER: _ClassVar[int]
    EXPIRES_AT_FIELD_NUMBER: _ClassVar[int]
    ERROR_FIELD_NUMBER: _ClassVar[int]
    RESULT_FIELD_NUMBER: _ClassVar[int]
    REPORT_FIELD_NUMBER: _ClassVar[int]
    id: str
    state: JobState
    name: str
    format: str
    options: DenoiseOptions
    bytes: int
    points: int
    progress: float
    attempts: int
    position: int
    created_at: _timestamp_pb2.Timestamp
    started_at: _timestamp_pb2.Timestamp
    finished_at: _timestamp_pb2.Timestamp
    expires_at: _timestamp_pb2.Timestamp
    error: JobError
    result: ResultInfo
    report: Report
    def __init__(self, id: _Optional[str] = ..., state: _Optional[_Union[JobState, str]] = ..., name: _Optional[str] = ..., format: _Optional[str] = ..., options: _Optional[_Union[DenoiseOptions, _Mapping]] = ..., bytes: _Optional[int] = ..., points: _Optional[int] = ..., progress: _Optional[float] = ..., attempts: _Optional[int] = ..., position: _Optional[int] = ..., created_at: _Optional[_Union[datetime.datetime, _timestamp_pb2.Timestamp, _Mapping]] = ..., started_at: _Optional[_Union[datetime.datetime, _timestamp_pb2.Timestamp, _Mapping]] = ..., finished_at: _Optional[_Union[datetime.datetime, _timestamp_pb2.Timestamp, _Mapping]] = ..., expires_at: _Optional[_Union[datetime.datetime, _timestamp_pb2.Timestamp, _Mapping]] = ..., error: _Optional[_Union[JobError, _Mapping]] = ..., result: _Optional[_Union[ResultInfo, _Mapping]] = ..., report: _Optional[_Union[Report, _Mapping]] = ...) -> None: ...

class JobError(_message.Message):
    __slots__ = ("code", "detail", "retryable")
    CODE_FIELD_NUMBER: _ClassVar[int]
    DETAIL_FIELD_NUMBER: _ClassVar[int]
    RETRYABLE_FIELD_NUMBER: _ClassVar[int]
    code: str
    detail: str
    retryable: bool
    def __init__(self, code: _Optional[str] = ..., detail: _Optional[str] = ..., retryable: _Optional[bool] = ...) -> None: ...

class ResultInfo(_message.Message):
    __slots__ = ("bytes", "sha256", "media_type", "filename", "format")
    BYTES_FIELD_NUMBER: _ClassVar[int]
    SHA256_FIELD_NUMBER: _ClassVar[int]
    MEDIA_TYPE_FIELD_NUMBER: _ClassVar[int]
    FILENAME_FIELD_NUMBER: _ClassVar[int]
    FORMAT_FIELD_NUMBER: _ClassVar[int]
    bytes: int
    sha256: str
    media_type: str
    filename: str
    format: str
    def __init__(self, bytes: _Optional[int] = ..., sha256: _Optional[str] = ..., media_type: _Optional[str] = ..., filename: _Optional[str] = ..., format: _Optional[str] = ...) -> None: ...

class Report(_message.Message):
    __slots__ = ("format", "points", "untouched", "iterations", "noise_before", "noise_after", "distances", "displacement", "seconds", "timings", "device", "warnings")
    FORMAT_FIELD_NUMBER: _ClassVar[int]
    POINTS_FIELD_NUMBER: _ClassVar[int]
    UNTOUCHED_FIELD_NUMBER: _ClassVar[int]
    ITERATIONS_FIELD_NUMBER: _ClassVar[int]
    NOISE_BEFORE_FIELD_NUMBER: _ClassVar[int]
    NOISE_AFTER_FIELD_NUMBER: _ClassVar[int]
    DISTANCES_FIELD_NUMBER: _ClassVar[int]
    DISPLACEMENT_FIELD_NUMBER: _ClassVar[int]
    SECONDS_FIELD_NUMBER: _ClassVar[int]
    TIMINGS_FIELD_NUMBER: _ClassVar[int]
    DEVICE_FIELD_NUMBER: _ClassVar[int]
    WARNINGS_FIELD_NUMBER: _ClassVar[int]
    format: str
    points: int
    untouched: int
    iterations: int
    noise_before: float
    noise_after: float
    distances: _containers.RepeatedScalarFieldContainer[float]
    displacement: Displacement
    seconds: float
    timings: Timings
    device: str
    warnings: _containers.RepeatedScalarFieldContainer[str]
    def __init__(self, format: _Optional[str] = ..., points: _Optional[int] = ..., untouched: _Optional[int] = ..., iterations: _Optional[int] = ..., noise_before: _Optional[float] = ..., noise_after: _Optional[float] = ..., distances: _Optional[_Iterable[float]] = ..., displacement: _Optional[_Union[Displacement, _Mapping]] = ..., seconds: _Optional[float] = ..., timings: _Optional[_Union[Timings, _Mapping]] = ..., device: _Optional[str] = ..., warnings: _Optional[_Iterable[str]] = ...) -> None: ...

class Displacement(_message.Message):
    __slots__ = ("p50", "p90", "p99", "max", "mean")
    P50_FIELD_NUMBER: _ClassVar[int]
    P90_FIELD_NUMBER: _ClassVar[int]
    P99_FIELD_NUMBER: _ClassVar[int]
    MAX_FIELD_NUMBER: _ClassVar[int]
    MEAN_FIELD_NUMBER: _ClassVar[int]
    p50: float
    p90: float
    p99: float
    max: float
    mean: float
    def __init__(self, p50: _Optional[float] = ..., p90: _Optional[float] = ..., p99: _Optional[float] = ..., max: _Optional[float] = ..., mean: _Optional[float] = ...) -> None: ...

class Timings(_message.Message):
    __slots__ = ("read", "filter", "write")
    READ_FIELD_NUMBER: _ClassVar[int]
    FILTER_FIELD_NUMBER: _ClassVar[int]
    WRITE_FIELD_NUMBER: _ClassVar[int]
    read: float
    filter: float
    write: float
    def __init__(self, read: _Optional[float] = ..., filter: _Optional[float] = ..., write: _Optional[float] = ...) -> None: ...

class JobEvent(_message.Message):
    __slots__ = ("seq", "at", "queued", "start", "progress", "preview", "output", "log", "completed")
    SEQ_FIELD_NUMBER: _ClassVar[int]
    AT_FIELD_NUMBER: _ClassVar[int]
    QUEUED_FIELD_NUMBER: _ClassVar[int]
    START_FIELD_NUMBER: _ClassVar[int]
    PROGRESS_FIELD_NUMBER: _ClassVar[int]
    PREVIEW_FIELD_NUMBER: _ClassVar[int]
    OUTPUT_FIELD_NUMBER: _ClassVar[int]
    LOG_FIELD_NUMBER: _ClassVar[int]
    COMPLETED_FIELD_NUMBER: _ClassVar[int]
    seq: int
    at: _timestamp_pb2.Timestamp
    queued: Queued
    start: Started
    progress: Progress
    preview: Preview
    output: Output
    log: Log
    completed: Job
    def __init__(self, seq: _Optional[int] = ..., at: _Optional[_Union[datetime.datetime, _timestamp_pb2.Timestamp, _Mapping]] = ..., queued: _Optional[_Union[Queued, _Mapping]] = ..., start: _Optional[_Union[Started, _Mapping]] = ..., progress: _Optional[_Union[Progress, _Mapping]] = ..., preview: _Optional[_Union[Preview, _Mapping]] = ..., output: _Optional[_Union[Output, _Mapping]] = ..., log: _Optional[_Union[Log, _Mapping]] = ..., completed: _Optional[_Union[Job, _Mapping]] = ...) -> None: ...

class Queued(_message.Message):
    __slots__ = ("position",)
    POSITION_FIELD_NUMBER: _ClassVar[int]
    position: int
    def __init__(self, position: _Optional[int] = ...) -> None: ...

class Started(_message.Message):
    __slots__ = ("attempt", "device")
    ATTEMPT_FIELD_NUMBER: _ClassVar[int]
    DEVICE_FIELD_NUMBER: _ClassVar[int]
    attempt: int
    device: str
    def __init__(self, attempt: _Optional[int] = ..., device: _Optional[str] = ...) -> None: ...

class Progress(_message.Message):
    __slots__ = ("progress", "iteration")
    PROGRESS_FIELD_NUMBER: _ClassVar[int]
    ITERATION_FIELD_NUMBER: _ClassVar[int]
    progress: float
    iteration: int
    def __init__(self, progress: _Optional[float] = ..., iteration: _Optional[int] = ...) -> None: ...

class Preview(_message.Message):
    __slots__ = ("iteration", "indices", "xyz")
    ITERATION_FIELD_NUMBER: _ClassVar[int]
    INDICES_FIELD_NUMBER: _ClassVar[int]
    XYZ_FIELD_NUMBER: _ClassVar[int]
    iteration: int
    indices: _containers.RepeatedScalarFieldContainer[int]
    xyz: _containers.RepeatedScalarFieldContainer[float]
    def __init__(self, iteration: _Optional[int] = ..., indices: _Optional[_Iterable[int]] = ..., xyz: _Optional[_Iterable[float]] = ...) -> None: ...

class Output(_message.Message):
    __slots__ = ("bytes", "sha256", "filename", "media_type")
    BYTES_FIELD_NUMBER: _ClassVar[int]
    SHA256_FIELD_NUMBER: _ClassVar[int]
    FILENAME_FIELD_NUMBER: _ClassVar[int]
    MEDIA_TYPE_FIELD_NUMBER: _ClassVar[int]
    bytes: int
    sha256: str
    filename: str
    media_type: str
    def __init__(self, bytes: _Optional[int] = ..., sha256: _Optional[str] = ..., filename: _Optional[str] = ..., media_type: _Optional[str] = ...) -> None: ...

class Log(_message.Message):
    __slots__ = ("level", "message")
    LEVEL_FIELD_NUMBER: _ClassVar[int]
    MESSAGE_FIELD_NUMBER: _ClassVar[int]
    level: str
    message: str
    def __init__(self, level: _Optional[str] = ..., message: _Optional[str] = ...) -> None: ...

class Patch(_message.Message):
    __slots__ = ("iteration", "final", "progress", "indices", "xyz", "points")
    ITERATION_FIELD_NUMBER: _ClassVar[int]
    FINAL_FIELD_NUMBER: _ClassVar[int]
    PROGRESS_FIELD_NUMBER: _ClassVar[int]
    INDICES_FIELD_NUMBER: _ClassVar[int]
    XYZ_FIELD_NUMBER: _ClassVar[int]
    POINTS_FIELD_NUMBER: _ClassVar[int]
    iteration: int
    final: bool
    progress: float
    indices: _containers.RepeatedScalarFieldContainer[int]
    xyz: _containers.RepeatedScalarFieldContainer[float]
    points: int
    def __init__(self, iteration: _Optional[int] = ..., final: _Optional[bool] = ..., progress: _Optional[float] = ..., indices: _Optional[_Iterable[int]] = ..., xyz: _Optional[_Iterable[float]] = ..., points: _Optional[int] = ...) -> None: ...

class ServerInfo(_message.Message):
    __slots__ = ("version", "model", "weights", "devices", "max_bytes", "max_points", "max_jobs", "max_queued_points", "max_iterations", "max_sync_seconds", "result_ttl_seconds", "formats")
    VERSION_FIELD_NUMBER: _ClassVar[int]
    MODEL_FIELD_NUMBER: _ClassVar[int]
    WEIGHTS_FIELD_NUMBER: _ClassVar[int]
    DEVICES_FIELD_NUMBER: _ClassVar[int]
    MAX_BYTES_FIELD_NUMBER: _ClassVar[int]
    MAX_POINTS_FIELD_NUMBER: _ClassVar[int]
    MAX_JOBS_FIELD_NUMBER: _ClassVar[int]
    MAX_QUEUED_POINTS_FIELD_NUMBER: _ClassVar[int]
    MAX_ITERATIONS_FIELD_NUMBER: _ClassVar[int]
    MAX_SYNC_SECONDS_FIELD_NUMBER: _ClassVar[int]
    RESULT_TTL_SECONDS_FIELD_NUMBER: _ClassVar[int]
    FORMATS_FIELD_NUMBER: _ClassVar[int]
    version: str
    model: str
    weights: str
    devices: _containers.RepeatedScalarFieldContainer[str]
    max_bytes: int
    max_points: int
    max_jobs: int
    max_queued_points: int
    max_iterations: int
    max_sync_seconds: float
    result_ttl_seconds: float
    formats: _containers.RepeatedCompositeFieldContainer[FormatInfo]
    def __init__(self, version: _Optional[str] = ..., model: _Optional[str] = ..., weights: _Optional[str] = ..., devices: _Optional[_Iterable[str]] = ..., max_bytes: _Optional[int] = ..., max_points: _Optional[int] = ..., max_jobs: _Optional[int] = ..., max_queued_points: _Optional[int] = ..., max_iterations: _Optional[int] = ..., max_sync_seconds: _Optional[float] = ..., result_ttl_seconds: _Optional[float] = ..., formats: _Optional[_Iterable[_Union[FormatInfo, _Mapping]]] = ...) -> None: ...

class FormatInfo(_message.Message):
    __slots__ = ("name", "suffixes", "media_type")
    NAME_FIELD_NUMBER: _ClassVar[int]
    SUFFIXES_FIELD_NUMBER: _ClassVar[int]
    MEDIA_TYPE_FIELD_NUMBER: _ClassVar[int]
    name: str
    suffixes: _containers.RepeatedScalarFieldContainer[str]
    media_type: str
    def __init__(self, name: _Optional[str] = ..., suffixes: _Optional[_Iterable[str]] = ..., media_type: _Optional[str] = ...) -> None: ...
