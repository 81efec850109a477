from google.protobuf.internal import containers as _containers
from google.protobuf.internal import enum_type_wrapper as _enum_type_wrapper
from google.protobuf import descriptor as _descriptor
from google.protobuf import message as _message
from collections.abc import Iterable as _Iterable, Mapping as _Mapping
from typing import ClassVar as _ClassVar, Optional as _Optional, Union as _Union

DESCRIPTOR: _descriptor.FileDescriptor

class ClockSource(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    CLOCK_SOURCE_UNKNOWN: _ClassVar[ClockSource]
    CLOCK_SOURCE_FREE: _ClassVar[ClockSource]
    CLOCK_SOURCE_NTP: _ClassVar[ClockSource]
    CLOCK_SOURCE_PTP: _ClassVar[ClockSource]

class StampOrigin(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    STAMP_ORIGIN_UNKNOWN: _ClassVar[StampOrigin]
    STAMP_ORIGIN_CAMERA: _ClassVar[StampOrigin]
    STAMP_ORIGIN_DRIVER: _ClassVar[StampOrigin]
    STAMP_ORIGIN_TABLE: _ClassVar[StampOrigin]
    STAMP_ORIGIN_FILE: _ClassVar[StampOrigin]
    STAMP_ORIGIN_ARRIVAL: _ClassVar[StampOrigin]
    STAMP_ORIGIN_ORDER: _ClassVar[StampOrigin]

class SessionPhase(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    SESSION_PHASE_IDLE: _ClassVar[SessionPhase]
    SESSION_PHASE_BACKGROUND: _ClassVar[SessionPhase]
    SESSION_PHASE_WAVING: _ClassVar[SessionPhase]
    SESSION_PHASE_TILTS: _ClassVar[SessionPhase]
    SESSION_PHASE_SOLVING: _ClassVar[SessionPhase]
    SESSION_PHASE_DONE: _ClassVar[SessionPhase]
    SESSION_PHASE_FAILED: _ClassVar[SessionPhase]
CLOCK_SOURCE_UNKNOWN: ClockSource
CLOCK_SOURCE_FREE: ClockSource
CLOCK_SOURCE_NTP: ClockSource
CLOCK_SOURCE_PTP: ClockSource
STAMP_ORIGIN_UNKNOWN: StampOrigin
STAMP_ORIGIN_CAMERA: StampOrigin
STAMP_ORIGIN_DRIVER: StampOrigin
STAMP_ORIGIN_TABLE: StampOrigin
STAMP_ORIGIN_FILE: StampOrigin
STAMP_ORIGIN_ARRIVAL: StampOrigin
STAMP_ORIGIN_ORDER: StampOrigin
SESSION_PHASE_IDLE: SessionPhase
SESSION_PHASE_BACKGROUND: SessionPhase
SESSION_PHASE_WAVING: SessionPhase
SESSION_PHASE_TILTS: SessionPhase
SESSION_PHASE_SOLVING: SessionPhase
SESSION_PHASE_DONE: SessionPhase
SESSION_PHASE_FAILED: SessionPhase

class ClockQuality(_message.Message):
    __slots__ = ("source", "sigma_s")
    SOURCE_FIELD_NUMBER: _ClassVar[int]
    SIGMA_S_FIELD_NUMBER: _ClassVar[int]
    source: ClockSource
    sigma_s: float
    def __init__(self, source: _Optional[_Union[ClockSource, str]] = ..., sigma_s: _Optional[float] = ...) -> None: ...

class Header(_message.Message):
    __slots__ = ("schema", "node", "boot", "sequence", "stamp_ns", "clock", "session")
    SCHEMA_FIELD_NUMBER: _ClassVar[int]
    NODE_FIELD_NUMBER: _ClassVar[int]
    BOOT_FIELD_NUMBER: _ClassVar[int]
    SEQUENCE_FIELD_NUMBER: _ClassVar[int]
    STAMP_NS_FIELD_NUMBER: _ClassVar[int]
    CLOCK_FIELD_NUMBER: _ClassVar[int]
    SESSION_FIELD_NUMBER: _ClassVar[int]
    schema: int
    node: str
    boot: bytes
    sequence: int
    stamp_ns: int
    clock: ClockQuality
    session: str
    def __init__(self, schema: _Optional[int] = ..., node: _Optional[str] = ..., boot: _Optional[bytes] = ..., sequence: _Optional[int] = ..., stamp_ns: _Optional[int] = ..., clock: _Optional[_Union[ClockQuality, _Mapping]] = ..., session: _Optional[str] = ...) -> None: ...

class SpotBatch(_message.Message):
    __slots__ = ("header", "camera", "width_px", "height_px", "rate_hz", "origin", "frame_sequence", "frame_stamp_ns", "spot_frame", "x_px", "y_px", "sigma_px", "score", "n_dropped")
    HEADER_FIELD_NUMBER: _ClassVar[int]
    CAMERA_FIELD_NUMBER: _ClassVar[int]
    WIDTH_PX_FIELD_NUMBER: _ClassVar[int]
    HEIGHT_PX_FIELD_NUMBER: _ClassVar[int]
    RATE_HZ_FIELD_NUMBER: _ClassVar[int]
    ORIGIN_FIELD_NUMBER: _ClassVar[int]
    FRAME_SEQUENCE_FIELD_NUMBER: _ClassVar[int]
    FRAME_STAMP_NS_FIELD_NUMBER: _ClassVar[int]
    SPOT_FRAME_FIELD_NUMBER: _ClassVar[int]
    X_PX_FIELD_NUMBER: _ClassVar[int]
    Y_PX_FIELD_NUMBER: _ClassVar[int]
    SIGMA_PX_FIELD_NUMBER: _ClassVar[int]
    SCORE_FIELD_NUMBER: _ClassVar[int]
    N_DROPPED_FIELD_NUMBER: _ClassVar[int]
    header: Header
    camera: str
    width_px: int
    height_px: int
    rate_hz: float
    origin: StampOrigin
    frame_sequence: _containers.RepeatedScalarFieldContainer[int]
    frame_stamp_ns: _containers.RepeatedScalarFieldContainer[int]
    spot_frame: _containers.RepeatedScalarFieldContainer[int]
    x_px: _containers.RepeatedScalarFieldContainer[float]
    y_px: _containers.RepeatedScalarFieldContainer[float]
    sigma_px: _containers.RepeatedScalarFieldContainer[float]
    score: _containers.RepeatedScalarFieldContainer[float]
    n_dropped: int
    def __init__(self, header: _Optional[_Union[Header, _Mapping]] = ..., camera: _Optional[str] = ..., width_px: _Optional[int] = ..., height_px: _Optional[int] = ..., rate_hz: _Optional[float] = ..., origin: _Optional[_Union[StampOrigin, str]] = ..., frame_sequence: _Optional[_Iterable[int]] = ..., frame_stamp_ns: _Optional[_Iterable[int]] = ..., spot_frame: _Optional[_Iterable[int]] = ..., x_px: _Optional[_Iterable[float]] = ..., y_px: _Optional[_Iterable[float]] = ..., sigma_px: _Optional[_Iterable[float]] = ..., score: _Optional[_Iterable[float]] = ..., n_dropped: _Optional[int] = ...) -> None: ...

class LrfInfo(_message.Message):
    __slots__ = ("header", "lrf", "product", "serial", "firmware", "front_step", "steps_per_turn", "first_step", "last_step", "range_min_m", "range_max_m", "turn_s")
    HEADER_FIELD_NUMBER: _ClassVar[int]
    LRF_FIELD_NUMBER: _ClassVar[int]
    PRODUCT_FIELD_NUMBER: _ClassVar[int]
    SERIAL_FIELD_NUMBER: _ClassVar[int]
    FIRMWARE_FIELD_NUMBER: _ClassVar[int]
    FRONT_STEP_FIELD_NUMBER: _ClassVar[int]
    STEPS_PER_TURN_FIELD_NUMBER: _ClassVar[int]
    FIRST_STEP_FIELD_NUMBER: _ClassVar[int]
    LAST_STEP_FIELD_NUMBER: _ClassVar[int]
    RANGE_MIN_M_FIELD_NUMBER: _ClassVar[int]
    RANGE_MAX_M_FIELD_NUMBER: _ClassVar[int]
    TURN_S_FIELD_NUMBER: _ClassVar[int]
    header: Header
    lrf: str
    product: str
    serial: str
    firmware: str
    front_step: int
    steps_per_turn: int
    first_step: int
    last_step: int
    range_min_m: float
    range_max_m: float
    turn_s: float
    def __init__(self, header: _Optional[_Union[Header, _Mapping]] = ..., lrf: _Optional[str] = ..., product: _Optional[str] = ..., serial: _Optional[str] = ..., firmware: _Optional[str] = ..., front_step: _Optional[int] = ..., steps_per_turn: _Optional[int] = ..., first_step: _Optional[int] = ..., last_step: _Optional[int] = ..., range_min_m: _Optional[float] = ..., range_max_m: _Optional[float] = ..., turn_s: _Optional[float] = ...) -> None: ...

class LrfScan(_message.Message):
    __slots__ = ("header", "lrf", "scan", "stamp_ns", "sigma_s", "device_s", "readings_mm", "intensity")
    HEADER_FIELD_NUMBER: _ClassVar[int]
    LRF_FIELD_NUMBER: _ClassVar[int]
    SCAN_FIELD_NUMBER: _ClassVar[int]
    STAMP_NS_FIELD_NUMBER: _ClassVar[int]
    SIGMA_S_FIELD_NUMBER: _ClassVar[int]
    DEVICE_S_FIELD_NUMBER: _ClassVar[int]
    READINGS_MM_FIELD_NUMBER: _ClassVar[int]
    INTENSITY_FIELD_NUMBER: _ClassVar[int]
    header: Header
    lrf: str
    scan: int
    stamp_ns: int
    sigma_s: float
    device_s: float
    readings_mm: _containers.RepeatedScalarFieldContainer[int]
    intensity: _containers.RepeatedScalarFieldContainer[int]
    def __init__(self, header: _Optional[_Union[Header, _Mapping]] = ..., lrf: _Optional[str] = ..., scan: _Optional[int] = ..., stamp_ns: _Optional[int] = ..., sigma_s: _Optional[float] = ..., device_s: _Optional[float] = ..., readings_mm: _Optional[_Iterable[int]] = ..., intensity: _Optional[_Iterable[int]] = ...) -> None: ...

class LrfSpot(_message.Message):
    __slots__ = ("header", "lrf", "setting", "stamp_ns", "range_m", "bearing_rad", "range_sigma_m", "bearing_sigma_rad", "out_of_plane_sigma_m", "bias_bound_m", "n_spots")
    HEADER_FIELD_NUMBER: _ClassVar[int]
    LRF_FIELD_NUMBER: _ClassVar[int]
    SETTING_FIELD_NUMBER: _ClassVar[int]
    STAMP_NS_FIELD_NUMBER: _ClassVar[int]
    RANGE_M_FIELD_NUMBER: _ClassVar[int]
    BEARING_RAD_FIELD_NUMBER: _ClassVar[int]
    RANGE_SIGMA_M_FIELD_NUMBER: _ClassVar[int]
    BEARING_SIGMA_RAD_FIELD_NUMBER: _ClassVar[int]
    OUT_OF_PLANE_SIGMA_M_FIELD_NUMBER: _ClassVar[int]
    BIAS_BOUND_M_FIELD_NUMBER: _ClassVar[int]
    N_SPOTS_FIELD_NUMBER: _ClassVar[int]
    header: Header
    lrf: str
    setting: int
    stamp_ns: int
    range_m: float
    bearing_rad: float
    range_sigma_m: float
    bearing_sigma_rad: float
    out_of_plane_sigma_m: float
    bias_bound_m: float
    n_spots: int
    def __init__(self, header: _Optional[_Union[Header, _Mapping]] = ..., lrf: _Optional[str] = ..., setting: _Optional[int] = ..., stamp_ns: _Optional[int] = ..., range_m: _Optional[float] = ..., bearing_rad: _Optional[float] = ..., range_sigma_m: _Optional[float] = ..., bearing_sigma_rad: _Optional[float] = ..., out_of_plane_sigma_m: _Optional[float] = ..., bias_bound_m: _Optional[float] = ..., n_spots: _Optional[int] = ...) -> None: ...

class TiltSample(_message.Message):
    __slots__ = ("header", "lrf", "setting", "tilt_rad", "steps", "has_steps")
    HEADER_FIELD_NUMBER: _ClassVar[int]
    LRF_FIELD_NUMBER: _ClassVar[int]
    SETTING_FIELD_NUMBER: _ClassVar[int]
    TILT_RAD_FIELD_NUMBER: _ClassVar[int]
    STEPS_FIELD_NUMBER: _ClassVar[int]
    HAS_STEPS_FIELD_NUMBER: _ClassVar[int]
    header: Header
    lrf: str
    setting: int
    tilt_rad: float
    steps: int
    has_steps: bool
    def __init__(self, header: _Optional[_Union[Header, _Mapping]] = ..., lrf: _Optional[str] = ..., setting: _Optional[int] = ..., tilt_rad: _Optional[float] = ..., steps: _Optional[int] = ..., has_steps: _Optional[bool] = ...) -> None: ...

class TiltSettings(_message.Message):
    __slots__ = ("header", "lrf", "angle_rad", "covariance_rad2", "sources", "notes")
    HEADER_FIELD_NUMBER: _ClassVar[int]
    LRF_FIELD_NUMBER: _ClassVar[int]
    ANGLE_RAD_FIELD_NUMBER: _ClassVar[int]
    COVARIANCE_RAD2_FIELD_NUMBER: _ClassVar[int]
    SOURCES_FIELD_NUMBER: _ClassVar[int]
    NOTES_FIELD_NUMBER: _ClassVar[int]
    header: Header
    lrf: str
    angle_rad: _containers.RepeatedScalarFieldContainer[float]
    covariance_rad2: _containers.RepeatedScalarFieldContainer[float]
    sources: _containers.RepeatedScalarFieldContainer[str]
    notes: _containers.RepeatedScalarFieldContainer[str]
    def __init__(self, header: _Optional[_Union[Header, _Mapping]] = ..., lrf: _Optional[str] = ..., angle_rad: _Optional[_Iterable[float]] = ..., covariance_rad2: _Optional[_Iterable[float]] = ..., sources: _Optional[_Iterable[str]] = ..., notes: _Optional[_Iterable[str]] = ...) -> None: ...

class ImuBatch(_message.Message):
    __slots__ = ("header", "lrf", "sample", "device_s", "arrival_ns", "rate_rad_s", "acceleration_m_s2")
    HEADER_FIELD_NUMBER: _ClassVar[int]
    LRF_FIELD_NUMBER: _ClassVar[int]
    SAMPLE_FIELD_NUMBER: _ClassVar[int]
    DEVICE_S_FIELD_NUMBER: _ClassVar[int]
    ARRIVAL_NS_FIELD_NUMBER: _ClassVar[int]
    RATE_RAD_S_FIELD_NUMBER: _ClassVar[int]
    ACCELERATION_M_S2_FIELD_NUMBER: _ClassVar[int]
    header: Header
    lrf: str
    sample: _containers.RepeatedScalarFieldContainer[int]
    device_s: _containers.RepeatedScalarFieldContainer[float]
    arrival_ns: _containers.RepeatedScalarFieldContainer[int]
    rate_rad_s: _containers.RepeatedScalarFieldContainer[float]
    acceleration_m_s2: _containers.RepeatedScalarFieldContainer[float]
    def __init__(self, header: _Optional[_Union[Header, _Mapping]] = ..., lrf: _Optional[str] = ..., sample: _Optional[_Iterable[int]] = ..., device_s: _Optional[_Iterable[float]] = ..., arrival_ns: _Optional[_Iterable[int]] = ..., rate_rad_s: _Optional[_Iterable[float]] = ..., acceleration_m_s2: _Optional[_Iterable[float]] = ...) -> None: ...

class NodeEvent(_message.Message):
    __slots__ = ("header", "text")
    HEADER_FIELD_NUMBER: _ClassVar[int]
    TEXT_FIELD_NUMBER: _ClassVar[int]
    header: Header
    text: str
    def __init__(self, header: _Optional[_Union[Header, _Mapping]] = ..., text: _Optional[str] = ...) -> None: ...

class NodeStatus(_message.Message):
    __slots__ = ("header", "role", "state", "message", "rate_hz", "n_frames", "n_detections", "n_dropped", "journal_rows", "journal_dropped", "temperature_c", "has_temperature", "advice", "setting", "n_settings", "n_crossings", "plane_sigma_m")
    HEADER_FIELD_NUMBER: _ClassVar[int]
    ROLE_FIELD_NUMBER: _ClassVar[int]
    STATE_FIELD_NUMBER: _ClassVar[int]
    MESSAGE_FIELD_NUMBER: _ClassVar[int]
    RATE_HZ_FIELD_NUMBER: _ClassVar[int]
    N_FRAMES_FIELD_NUMBER: _ClassVar[int]
    N_DETECTIONS_FIELD_NUMBER: _ClassVar[int]
    N_DROPPED_FIELD_NUMBER: _ClassVar[int]
    JOURNAL_ROWS_FIELD_NUMBER: _ClassVar[int]
    JOURNAL_DROPPED_FIELD_NUMBER: _ClassVar[int]
    TEMPERATURE_C_FIELD_NUMBER: _ClassVar[int]
    HAS_TEMPERATURE_FIELD_NUMBER: _ClassVar[int]
    ADVICE_FIELD_NUMBER: _ClassVar[int]
    SETTING_FIELD_NUMBER: _ClassVar[int]
    N_SETTINGS_FIELD_NUMBER: _ClassVar[int]
    N_CROSSINGS_FIELD_NUMBER: _ClassVar[int]
    PLANE_SIGMA_M_FIELD_NUMBER: _ClassVar[int]
    header: Header
    role: str
    state: str
    message: str
    rate_hz: float
    n_frames: int
    n_detections: int
    n_dropped: int
    journal_rows: int
    journal_dropped: int
    temperature_c: float
    has_temperature: bool
    advice: _containers.RepeatedScalarFieldContainer[str]
    setting: int
    n_settings: int
    n_crossings: int
    plane_sigma_m: float
    def __init__(self, header: _Optional[_Union[Header, _Mapping]] = ..., role: _Optional[str] = ..., state: _Optional[str] = ..., message: _Optional[str] = ..., rate_hz: _Optional[float] = ..., n_frames: _Optional[int] = ..., n_detections: _Optional[int] = ..., n_dropped: _Optional[int] = ..., journal_rows: _Optional[int] = ..., journal_dropped: _Optional[int] = ..., temperature_c: _Optional[float] = ..., has_temperature: _Optional[bool] = ..., advice: _Optional[_Iterable[str]] = ..., setting: _Optional[int] = ..., n_settings: _Optional[int] = ..., n_crossings: _Optional[int] = ..., plane_sigma_m: _Optional[float] = ...) -> None: ...

class SessionState(_message.Message):
    __slots__ = ("header", "phase", "message")
    HEADER_FIELD_NUMBER: _ClassVar[int]
    PHASE_FIELD_NUMBER: _ClassVar[int]
    MESSAGE_FIELD_NUMBER: _ClassVar[int]
    header: Header
    phase: SessionPhase
    message: str
    def __init__(self, header: _Optional[_Union[Header, _Mapping]] = ..., phase: _Optional[_Union[SessionPhase, str]] = ..., message: _Optional[str] = ...) -> None: ...

class Command(_message.Message):
    __slots__ = ("header", "verb", "number", "tilts_rad", "n_crossings", "is_late")
    HEADER_FIELD_NUMBER: _ClassVar[int]
    VERB_FIELD_NUMBER: _ClassVar[int]
    NUMBER_FIELD_NUMBER: _ClassVar[int]
    TILTS_RAD_FIELD_NUMBER: _ClassVar[int]
    N_CROSSINGS_FIELD_NUMBER: _ClassVar[int]
    IS_LATE_FIELD_NUMBER: _ClassVar[int]
    header: Header
    verb: str
    number: float
    tilts_rad: _containers.RepeatedScalarFieldContainer[float]
    n_crossings: int
    is_late: bool
    def __init__(self, header: _Optional[_Union[Header, _Mapping]] = ..., verb: _Optional[str] = ..., number: _Optional[float] = ..., tilts_rad: _Optional[_Iterable[float]] = ..., n_crossings: _Optional[int] = ..., is_late: _Optional[bool] = ...) -> None: ...

class Reply(_message.Message):
    __slots__ = ("header", "code", "message", "content")
    HEADER_FIELD_NUMBER: _ClassVar[int]
    CODE_FIELD_NUMBER: _ClassVar[int]
    MESSAGE_FIELD_NUMBER: _ClassVar[int]
    CONTENT_FIELD_NUMBER: _ClassVar[int]
    header: Header
    code: str
    message: str
    content: bytes
    def __init__(self, header: _Optional[_Union[Header, _Mapping]] = ..., code: _Optional[str] = ..., message: _Optional[str] = ..., content: _Optional[bytes] = ...) -> None: ...

class JournalRow(_message.Message):
    __slots__ = ("key", "payload")
    KEY_FIELD_NUMBER: _ClassVar[int]
    PAYLOAD_FIELD_NUMBER: _ClassVar[int]
    key: str
    payload: bytes
    def __init__(self, key: _Optional[str] = ..., payload: _Optional[bytes] = ...) -> None: ...

class JournalRows(_message.Message):
    __slots__ = ("rows",)
    ROWS_FIELD_NUMBER: _ClassVar[int]
    rows: _containers.RepeatedCompositeFieldContainer[JournalRow]
    def __init__(self, rows: _Optional[_Iterable[_Union[JournalRow, _Mapping]]] = ...) -> None: ...

class JournalSpan(_message.Message):
    __slots__ = ("boot", "first", "last", "n_dropped")
    BOOT_FIELD_NUMBER: _ClassVar[int]
    FIRST_FIELD_NUMBER: _ClassVar[int]
    LAST_FIELD_NUMBER: _ClassVar[int]
    N_DROPPED_FIELD_NUMBER: _ClassVar[int]
    boot: bytes
    first: int
    last: int
    n_dropped: int
    def __init__(self, boot: _Optional[bytes] = ..., first: _Optional[int] = ..., last: _Optional[int] = ..., n_dropped: _Optional[int] = ...) -> None: ...

class JournalSummary(_message.Message):
    __slots__ = ("header", "spans")
    HEADER_FIELD_NUMBER: _ClassVar[int]
    SPANS_FIELD_NUMBER: _ClassVar[int]
    header: Header
    spans: _containers.RepeatedCompositeFieldContainer[JournalSpan]
    def __init__(self, header: _Optional[_Union[Header, _Mapping]] = ..., spans: _Optional[_Iterable[_Union[JournalSpan, _Mapping]]] = ...) -> None: ...

class Calibration(_message.Message):
    __slots__ = ("header", "id", "is_final", "calibration_json")
    HEADER_FIELD_NUMBER: _ClassVar[int]
    ID_FIELD_NUMBER: _ClassVar[int]
    IS_FINAL_FIELD_NUMBER: _ClassVar[int]
    CALIBRATION_JSON_FIELD_NUMBER: _ClassVar[int]
    header: Header
    id: str
    is_final: bool
    calibration_json: bytes
    def __init__(self, header: _Optional[_Union[Header, _Mapping]] = ..., id: _Optional[str] = ..., is_final: _Optional[bool] = ..., calibration_json: _Optional[bytes] = ...) -> None: ...

class Projection(_message.Message):
    __slots__ = ("header", "lrf", "camera", "calibration_id", "scan", "stamp_ns", "first_step", "n_beams", "px", "range_m", "sigma_px", "is_valid", "step_s", "tilt_rad", "tilt_sigma_rad")
    HEADER_FIELD_NUMBER: _ClassVar[int]
    LRF_FIELD_NUMBER: _ClassVar[int]
    CAMERA_FIELD_NUMBER: _ClassVar[int]
    CALIBRATION_ID_FIELD_NUMBER: _ClassVar[int]
    SCAN_FIELD_NUMBER: _ClassVar[int]
    STAMP_NS_FIELD_NUMBER: _ClassVar[int]
    FIRST_STEP_FIELD_NUMBER: _ClassVar[int]
    N_BEAMS_FIELD_NUMBER: _ClassVar[int]
    PX_FIELD_NUMBER: _ClassVar[int]
    RANGE_M_FIELD_NUMBER: _ClassVar[int]
    SIGMA_PX_FIELD_NUMBER: _ClassVar[int]
    IS_VALID_FIELD_NUMBER: _ClassVar[int]
    STEP_S_FIELD_NUMBER: _ClassVar[int]
    TILT_RAD_FIELD_NUMBER: _ClassVar[int]
    TILT_SIGMA_RAD_FIELD_NUMBER: _ClassVar[int]
    header: Header
    lrf: str
    camera: str
    calibration_id: str
    scan: int
    stamp_ns: int
    first_step: int
    n_beams: int
    px: bytes
    range_m: bytes
    sigma_px: bytes
    is_valid: bytes
    step_s: float
    tilt_rad: float
    tilt_sigma_rad: float
    def __init__(self, header: _Optional[_Union[Header, _Mapping]] = ..., lrf: _Optional[str] = ..., camera: _Optional[str] = ..., calibration_id: _Optional[str] = ..., scan: _Optional[int] = ..., stamp_ns: _Optional[int] = ..., first_step: _Optional[int] = ..., n_beams: _Optional[int] = ..., px: _Optional[bytes] = ..., range_m: _Optional[bytes] = ..., sigma_px: _Optional[bytes] = ..., is_valid: _Optional[bytes] = ..., step_s: _Optional[float] = ..., tilt_rad: _Optional[float] = ..., tilt_sigma_rad: _Optional[float] = ...) -> None: ...

class Beams(_message.Message):
    __slots__ = ("lrf", "range_m", "bearing_rad", "tilt_rad", "stamp_ns")
    LRF_FIELD_NUMBER: _ClassVar[int]
    RANGE_M_FIELD_NUMBER: _ClassVar[int]
    BEARING_RAD_FIELD_NUMBER: _ClassVar[int]
    TILT_RAD_FIELD_NUMBER: _ClassVar[int]
    STAMP_NS_FIELD_NUMBER: _ClassVar[int]
    lrf: str
    range_m: bytes
    bearing_rad: bytes
    tilt_rad: bytes
    stamp_ns: int
    def __init__(self, lrf: _Optional[str] = ..., range_m: _Optional[bytes] = ..., bearing_rad: _Optional[bytes] = ..., tilt_rad: _Optional[bytes] = ..., stamp_ns: _Optional[int] = ...) -> None: ...

class LrfPoints(_message.Message):
    __slots__ = ("lrf", "xyz_m", "tilt_rad", "stamp_ns")
    LRF_FIELD_NUMBER: _ClassVar[int]
    XYZ_M_FIELD_NUMBER: _ClassVar[int]
    TILT_RAD_FIELD_NUMBER: _ClassVar[int]
    STAMP_NS_FIELD_NUMBER: _ClassVar[int]
    lrf: str
    xyz_m: bytes
    tilt_rad: bytes
    stamp_ns: int
    def __init__(self, lrf: _Optional[str] = ..., xyz_m: _Optional[bytes] = ..., tilt_rad: _Optional[bytes] = ..., stamp_ns: _Optional[int] = ...) -> None: ...

class WorldPoints(_message.Message):
    __slots__ = ("xyz_m",)
    XYZ_M_FIELD_NUMBER: _ClassVar[int]
    xyz_m: bytes
    def __init__(self, xyz_m: _Optional[bytes] = ...) -> None: ...

class LrfNoise(_message.Message):
    __slots__ = ("range_floor_m", "range_per_m", "bearing_rad", "tilt_rad")
    RANGE_FLOOR_M_FIELD_NUMBER: _ClassVar[int]
    RANGE_PER_M_FIELD_NUMBER: _ClassVar[int]
    BEARING_RAD_FIELD_NUMBER: _ClassVar[int]
    TILT_RAD_FIELD_NUMBER: _ClassVar[int]
    range_floor_m: float
    range_per_m: float
    bearing_rad: float
    tilt_rad: float
    def __init__(self, range_floor_m: _Optional[float] = ..., range_per_m: _Optional[float] = ..., bearing_rad: _Optional[float] = ..., tilt_rad: _Optional[float] = ...) -> None: ...

class CovarianceOf(_message.Message):
    __slots__ = ("is_calibration_exact", "is_measurement_exact", "noise", "point_sigma_m")
    IS_CALIBRATION_EXACT_FIELD_NUMBER: _ClassVar[int]
    IS_MEASUREMENT_EXACT_FIELD_NUMBER: _ClassVar[int]
    NOISE_FIELD_NUMBER: _ClassVar[int]
    POINT_SIGMA_M_FIELD_NUMBER: _ClassVar[int]
    is_calibration_exact: bool
    is_measurement_exact: bool
    noise: LrfNoise
    point_sigma_m: float
    def __init__(self, is_calibration_exact: _Optional[bool] = ..., is_measurement_exact: _Optional[bool] = ..., noise: _Optional[_Union[LrfNoise, _Mapping]] = ..., point_sigma_m: _Optional[float] = ...) -> None: ...

class ProjectRequest(_message.Message):
    __slots__ = ("calibration_id", "cameras", "covariance", "beams", "lrf_points", "world_points")
    CALIBRATION_ID_FIELD_NUMBER: _ClassVar[int]
    CAMERAS_FIELD_NUMBER: _ClassVar[int]
    COVARIANCE_FIELD_NUMBER: _ClassVar[int]
    BEAMS_FIELD_NUMBER: _ClassVar[int]
    LRF_POINTS_FIELD_NUMBER: _ClassVar[int]
    WORLD_POINTS_FIELD_NUMBER: _ClassVar[int]
    calibration_id: str
    cameras: _containers.RepeatedScalarFieldContainer[str]
    covariance: CovarianceOf
    beams: Beams
    lrf_points: LrfPoints
    world_points: WorldPoints
    def __init__(self, calibration_id: _Optional[str] = ..., cameras: _Optional[_Iterable[str]] = ..., covariance: _Optional[_Union[CovarianceOf, _Mapping]] = ..., beams: _Optional[_Union[Beams, _Mapping]] = ..., lrf_points: _Optional[_Union[LrfPoints, _Mapping]] = ..., world_points: _Optional[_Union[WorldPoints, _Mapping]] = ...) -> None: ...

class ProjectReply(_message.Message):
    __slots__ = ("calibration_id", "cameras", "n_points", "px", "is_valid", "depth_m", "covariance_px2", "tilt_rad")
    CALIBRATION_ID_FIELD_NUMBER: _ClassVar[int]
    CAMERAS_FIELD_NUMBER: _ClassVar[int]
    N_POINTS_FIELD_NUMBER: _ClassVar[int]
    PX_FIELD_NUMBER: _ClassVar[int]
    IS_VALID_FIELD_NUMBER: _ClassVar[int]
    DEPTH_M_FIELD_NUMBER: _ClassVar[int]
    COVARIANCE_PX2_FIELD_NUMBER: _ClassVar[int]
    TILT_RAD_FIELD_NUMBER: _ClassVar[int]
    calibration_id: str
    cameras: _containers.RepeatedScalarFieldContainer[str]
    n_points: int
    px: bytes
    is_valid: bytes
    depth_m: bytes
    covariance_px2: bytes
    tilt_rad: bytes
    def __init__(self, calibration_id: _Optional[str] = ..., cameras: _Optional[_Iterable[str]] = ..., n_points: _Optional[int] = ..., px: _Optional[bytes] = ..., is_valid: _Optional[bytes] = ..., depth_m: _Optional[bytes] = ..., covariance_px2: _Optional[bytes] = ..., tilt_rad: _Optional[bytes] = ...) -> None: ...

class Pixels(_message.Message):
    __slots__ = ("camera", "px")
    CAMERA_FIELD_NUMBER: _ClassVar[int]
    PX_FIELD_NUMBER: _ClassVar[int]
    camera: str
    px: bytes
    def __init__(self, camera: _Optional[str] = ..., px: _Optional[bytes] = ...) -> None: ...

class Plane(_message.Message):
    __slots__ = ("normal_x", "normal_y", "normal_z", "offset")
    NORMAL_X_FIELD_NUMBER: _ClassVar[int]
    NORMAL_Y_FIELD_NUMBER: _ClassVar[int]
    NORMAL_Z_FIELD_NUMBER: _ClassVar[int]
    OFFSET_FIELD_NUMBER: _ClassVar[int]
    normal_x: float
    normal_y: float
    normal_z: float
    offset: float
    def __init__(self, normal_x: _Optional[float] = ..., normal_y: _Optional[float] = ..., normal_z: _Optional[float] = ..., offset: _Optional[float] = ...) -> None: ...

class FloorPixels(_message.Message):
    __slots__ = ("pixels", "sigma_px", "plane")
    PIXELS_FIELD_NUMBER: _ClassVar[int]
    SIGMA_PX_FIELD_NUMBER: _ClassVar[int]
    PLANE_FIELD_NUMBER: _ClassVar[int]
    pixels: Pixels
    sigma_px: float
    plane: Plane
    def __init__(self, pixels: _Optional[_Union[Pixels, _Mapping]] = ..., sigma_px: _Optional[float] = ..., plane: _Optional[_Union[Plane, _Mapping]] = ...) -> None: ...

class SeenPixels(_message.Message):
    __slots__ = ("pixels", "sigma_px")
    PIXELS_FIELD_NUMBER: _ClassVar[int]
    SIGMA_PX_FIELD_NUMBER: _ClassVar[int]
    pixels: _containers.RepeatedCompositeFieldContainer[Pixels]
    sigma_px: float
    def __init__(self, pixels: _Optional[_Iterable[_Union[Pixels, _Mapping]]] = ..., sigma_px: _Optional[float] = ...) -> None: ...

class LocateRequest(_message.Message):
    __slots__ = ("calibration_id", "rays", "floor", "triangulated")
    CALIBRATION_ID_FIELD_NUMBER: _ClassVar[int]
    RAYS_FIELD_NUMBER: _ClassVar[int]
    FLOOR_FIELD_NUMBER: _ClassVar[int]
    TRIANGULATED_FIELD_NUMBER: _ClassVar[int]
    calibration_id: str
    rays: Pixels
    floor: FloorPixels
    triangulated: SeenPixels
    def __init__(self, calibration_id: _Optional[str] = ..., rays: _Optional[_Union[Pixels, _Mapping]] = ..., floor: _Optional[_Union[FloorPixels, _Mapping]] = ..., triangulated: _Optional[_Union[SeenPixels, _Mapping]] = ...) -> None: ...

class LocateReply(_message.Message):
    __slots__ = ("calibration_id", "n_points", "is_valid", "origin_m", "direction", "xyz_m", "covariance_m2")
    CALIBRATION_ID_FIELD_NUMBER: _ClassVar[int]
    N_POINTS_FIELD_NUMBER: _ClassVar[int]
    IS_VALID_FIELD_NUMBER: _ClassVar[int]
    ORIGIN_M_FIELD_NUMBER: _ClassVar[int]
    DIRECTION_FIELD_NUMBER: _ClassVar[int]
    XYZ_M_FIELD_NUMBER: _ClassVar[int]
    COVARIANCE_M2_FIELD_NUMBER: _ClassVar[int]
    calibration_id: str
    n_points: int
    is_valid: bytes
    origin_m: bytes
    direction: bytes
    xyz_m: bytes
    covariance_m2: bytes
    def __init__(self, calibration_id: _Optional[str] = ..., n_points: _Optional[int] = ..., is_valid: _Optional[bytes] = ..., origin_m: _Optional[bytes] = ..., direction: _Optional[bytes] = ..., xyz_m: _Optional[bytes] = ..., covariance_m2: _Optional[bytes] = ...) -> None: ...

class BearingsRequest(_message.Message):
    __slots__ = ("calibration_id", "lrf", "xyz_m", "pixels", "tilt_rad", "stamp_ns")
    CALIBRATION_ID_FIELD_NUMBER: _ClassVar[int]
    LRF_FIELD_NUMBER: _ClassVar[int]
    XYZ_M_FIELD_NUMBER: _ClassVar[int]
    PIXELS_FIELD_NUMBER: _ClassVar[int]
    TILT_RAD_FIELD_NUMBER: _ClassVar[int]
    STAMP_NS_FIELD_NUMBER: _ClassVar[int]
    calibration_id: str
    lrf: str
    xyz_m: bytes
    pixels: Pixels
    tilt_rad: bytes
    stamp_ns: int
    def __init__(self, calibration_id: _Optional[str] = ..., lrf: _Optional[str] = ..., xyz_m: _Optional[bytes] = ..., pixels: _Optional[_Union[Pixels, _Mapping]] = ..., tilt_rad: _Optional[bytes] = ..., stamp_ns: _Optional[int] = ...) -> None: ...

class BearingsReply(_message.Message):
    __slots__ = ("calibration_id", "lrf", "n_points", "bearing_rad", "range_m", "out_of_plane_m", "step", "is_seen")
    CALIBRATION_ID_FIELD_NUMBER: _ClassVar[int]
    LRF_FIELD_NUMBER: _ClassVar[int]
    N_POINTS_FIELD_NUMBER: _ClassVar[int]
    BEARING_RAD_FIELD_NUMBER: _ClassVar[int]
    RANGE_M_FIELD_NUMBER: _ClassVar[int]
    OUT_OF_PLANE_M_FIELD_NUMBER: _ClassVar[int]
    STEP_FIELD_NUMBER: _ClassVar[int]
    IS_SEEN_FIELD_NUMBER: _ClassVar[int]
    calibration_id: str
    lrf: str
    n_points: int
    bearing_rad: bytes
    range_m: bytes
    out_of_plane_m: bytes
    step: bytes
    is_seen: bytes
    def __init__(self, calibration_id: _Optional[str] = ..., lrf: _Optional[str] = ..., n_points: _Optional[int] = ..., bearing_rad: _Optional[bytes] = ..., range_m: _Optional[bytes] = ..., out_of_plane_m: _Optional[bytes] = ..., step: _Optional[bytes] = ..., is_seen: _Optional[bytes] = ...) -> None: ...

class ErrorReply(_message.Message):
    __slots__ = ("code", "message", "detail")
    CODE_FIELD_NUMBER: _ClassVar[int]
    MESSAGE_FIELD_NUMBER: _ClassVar[int]
    DETAIL_FIELD_NUMBER: _ClassVar[int]
    code: str
    message: str
    detail: str
    def __init__(self, code: _Optional[str] = ..., message: _Optional[str] = ..., detail: _Optional[str] = ...) -> None: ...
