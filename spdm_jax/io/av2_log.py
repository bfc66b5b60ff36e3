"""Motion in an Argoverse 2 sensor log: feather tables -> ego states and tracks on a 0.1 s grid.

The source gives poses only: the ego's in the city frame at about 200 Hz, boxes in the ego frame of
each sweep at about 10 Hz (the interval wanders by milliseconds). Here everything is moved to the
city frame, resampled by time to an exact 0.1 s grid that starts at the first sweep, and
differentiated by local polynomial fits.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from spdm_jax.io.raw import RawTracks, ScenarioError
from spdm_jax.types import ObjectType

if TYPE_CHECKING:
    import polars as pl

STEP_NS = 100_000_000
"""Grid interval, ns."""
SWEEP_TOLERANCE_NS = STEP_NS // 2
"""A box counts as seen at a grid step if a sweep that holds it is this near, ns."""
POSE_TOLERANCE_NS = 10_000_000
"""Largest distance of a sweep from its ego pose, ns (sweeps have a pose of their own time)."""
TRACK_HALF_WINDOW = 0.35
"""Straight-line fit to box centres, +- s (annotations jitter by centimetres)."""
TRACK_MIN_SPEED = 0.25
"""Slower objects stand, m/s: what is left of the jitter after the fit."""
EGO_HALF_WINDOW = 0.25
"""Quadratic fit to ego poses, +- s."""
EGO_MIN_SPEED = 0.05
"""Slower, the ego stands, m/s (nuPlan's threshold for a stopped vehicle)."""
STEERING_MIN_SPEED = 0.5
"""Below this speed the yaw rate says nothing about the steering angle, m/s."""

_VEHICLES = (
    "REGULAR_VEHICLE LARGE_VEHICLE BUS BOX_TRUCK TRUCK TRUCK_CAB VEHICULAR_TRAILER SCHOOL_BUS "
    "ARTICULATED_BUS RAILED_VEHICLE MESSAGE_BOARD_TRAILER TRAFFIC_LIGHT_TRAILER"
)
_CYCLES = "BICYCLE BICYCLIST MOTORCYCLE MOTORCYCLIST WHEELED_DEVICE WHEELED_RIDER"

CATEGORIES: dict[str, ObjectType] = {
    **dict.fromkeys(_VEHICLES.split(), ObjectType.VEHICLE),
    **dict.fromkeys(_CYCLES.split(), ObjectType.BICYCLE),
    **dict.fromkeys(
        "PEDESTRIAN STROLLER WHEELCHAIR OFFICIAL_SIGNALER".split(), ObjectType.PEDESTRIAN
    ),
    "CONSTRUCTION_CONE": ObjectType.TRAFFIC_CONE,
    "CONSTRUCTION_BARREL": ObjectType.BARRIER,
    "BOLLARD": ObjectType.BARRIER,
    **dict.fromkeys("SIGN STOP_SIGN MOBILE_PEDESTRIAN_SIGN".split(), ObjectType.CZONE_SIGN),
    # nuPlan counts animals among its generic objects.
    **dict.fromkeys("DOG ANIMAL".split(), ObjectType.GENERIC_OBJECT),
}
"""nuPlan's class of every category; cycles include powered ones, as nuPlan has it."""

_POSE = ("timestamp_ns", "qw", "qx", "qy", "qz", "tx_m", "ty_m", "tz_m")
_BOX = (*_POSE, "track_uuid", "category", "length_m", "width_m")


@dataclass(frozen=True)
class AV2Motion:
    """Ego and objects of one log over its whole grid.

    Attributes:
      time_ns: `[T]` int64 grid times.
      ego: `[T, 11]` rear-axle states in the column order of `RawScenario.ego`, city frame.
      tracks: `[A, T]` objects, city frame.
      notes: remarks for the user.
    """

    time_ns: np.ndarray
    ego: np.ndarray
    tracks: RawTracks
    notes: tuple[str, ...]


def annotation_file(log: Path) -> Path:
    """Returns the box table of a log, which goes by one of two names.

    Raises:
      ScenarioError: there is none.
    """
    for name in ("annotations.feather", "annotations_with_ego.feather"):
        if (log / name).is_file():
            return log / name
    raise ScenarioError(
        f"{log}: neither annotations.feather nor annotations_with_ego.feather; "
        "only annotated logs (train, val) can be read"
    )


def grid_times(log: Path) -> np.ndarray:
    """Returns `[T]` int64 grid times of a log, ns: every 0.1 s while boxes and poses last.

    Raises:
      ScenarioError: a table is missing, malformed, or ends before the other one starts.
    """
    boxes = _table(annotation_file(log), ("timestamp_ns",))["timestamp_ns"].to_numpy()
    poses = _table(log / "city_SE3_egovehicle.feather", ("timestamp_ns",))
    pose_ns = poses["timestamp_ns"].to_numpy()
    sweeps = boxes[(boxes >= pose_ns.min()) & (boxes <= pose_ns.max())]
    if not len(sweeps):
        raise ScenarioError(
            f"{annotation_file(log)}: no timestamp_ns within those of city_SE3_egovehicle.feather "
            f"({pose_ns.min()} to {pose_ns.max()}); take both tables from the same log"
        )
    # A grid that keeps step with the sweeps may overshoot the last one by their jitter.
    last = sweeps.max() + POSE_TOLERANCE_NS
    return np.arange(sweeps.min(), last + 1, STEP_NS, dtype=np.int64)


def read_motion(log: Path, *, wheel_base: float) -> AV2Motion:
    """Reads ego and objects of one log.

    Args:
      log: folder of the log.
      wheel_base: m, of the vehicle that shall plan (the steering angle follows from the yaw rate).

    Raises:
      ScenarioError: a table is missing or malformed, a sweep has no ego pose, or a field holds a
        value that is no number.
    """
    time_ns = grid_times(log)
    poses = _table(log / "city_SE3_egovehicle.feather", _POSE).sort("timestamp_ns")
    boxes = _table(annotation_file(log), _BOX).sort("timestamp_ns", maintain_order=True)
    # The row of the ego itself would be an obstacle on top of it.
    boxes = boxes.filter(boxes["category"] != "EGO_VEHICLE")
    notes = []
    unknown = sorted(set(boxes["category"].unique().to_list()) - set(CATEGORIES))
    if unknown:
        notes.append(f"categories {', '.join(unknown)} are unknown: taken as generic objects")
    return AV2Motion(
        time_ns=time_ns,
        ego=_ego_states(poses, time_ns, wheel_base),
        tracks=_tracks(boxes, poses, time_ns, annotation_file(log)),
        notes=tuple(notes),
    )


def local_derivatives(
    time: np.ndarray, values: np.ndarray, at: np.ndarray, half_window: float, degree: int
) -> np.ndarray:
    """Differentiates a noisy signal by a polynomial fit around each query time.

    Args:
      time: `[N]` s.
      values: `[N, D]`.
      at: `[T]` s.
      half_window: samples within +- this of the query time count equally, s.
      degree: of the polynomial.

    Returns:
      `[degree, T, D]`: first to last derivative; 0 where fewer than `degree + 1` samples are near.
    """
    offset = (time[None, :] - at[:, None]) / half_window
    near = np.abs(offset) <= 1.0
    basis = near[..., None] * offset[..., None] ** np.arange(degree + 1)
    columns = basis.swapaxes(1, 2)
    # Scaled offsets keep the normal equations well conditioned; coinciding samples need the pinv.
    fit = np.linalg.pinv(columns @ basis, rcond=1e-9, hermitian=True) @ (columns @ values)
    fit[near.sum(1) <= degree] = 0.0
    # Derivative k of a polynomial in time / half_window is k! c_k / half_window^k.
    scale = np.cumprod(np.arange(1, degree + 1) / half_window)
    return np.moveaxis(fit[:, 1:] * scale[:, None], 1, 0)


def _table(path: Path, columns: tuple[str, ...]) -> "pl.DataFrame":
    try:
        import polars as pl
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(
            "reading Argoverse 2 logs needs polars: pip install 'spdm-jax[data]'"
        ) from error
    if not path.is_file():
        raise ScenarioError(f"{path}: no such file; a log needs it")
    try:
        names = pl.read_ipc_schema(path)
        missing = [c for c in columns if c not in names]
        if missing:
            raise ScenarioError(
                f"{path}: column {missing[0]} is missing (it has {', '.join(names)}); "
                "expected the Argoverse 2 sensor format"
            )
        table = pl.read_ipc(path, columns=list(columns))
    except pl.exceptions.PolarsError as error:
        raise ScenarioError(f"{path}: not a feather file ({error}); copy it again") from error
    if not len(table):
        raise ScenarioError(f"{path}: the table has no row; take an annotated log")
    for name, column in table.to_dict().items():
        bad = ~column.is_finite() if column.dtype.is_float() else column.is_null()
        if bad.any() or column.has_nulls():
            row = int(np.flatnonzero(bad.fill_null(True).to_numpy())[0])
            raise ScenarioError(
                f"{path}: column {name}, row {row} is {column[row]}; remove the row or repair it"
            )
    return table


def _ego_states(poses: "pl.DataFrame", time_ns: np.ndarray, wheel_base: float) -> np.ndarray:
    """Ego at the grid times; the origin of the source's ego frame is the rear axle."""
    start = time_ns[0]
    time = (poses["timestamp_ns"].to_numpy() - start) / 1e9
    at = (time_ns - start) / 1e9
    xy = poses.select("tx_m", "ty_m").to_numpy()
    yaw = np.unwrap(_yaw(_rotation(poses)))
    values = np.column_stack([xy - xy[0], yaw])
    rate, second = local_derivatives(time, values, at, EGO_HALF_WINDOW, degree=2)
    pose = np.column_stack([np.interp(at, time, c) for c in (*xy.T, yaw)])
    c, s = np.cos(pose[:, 2]), np.sin(pose[:, 2])
    to_body = np.stack([np.stack([c, s], -1), np.stack([-s, c], -1)], axis=1)
    velocity, acceleration = (np.einsum("tij,tj->ti", to_body, v[:, :2]) for v in (rate, second))
    yaw_rate, yaw_acceleration = rate[:, 2], second[:, 2]
    standing = np.hypot(*velocity.T) < EGO_MIN_SPEED
    fast = velocity[:, 0] > STEERING_MIN_SPEED
    steering = np.arctan2(wheel_base * yaw_rate, velocity[:, 0]) * fast
    ego = np.column_stack(
        [pose, velocity, acceleration, steering, np.zeros(len(at)), yaw_rate, yaw_acceleration]
    )
    ego[:, 2] = _wrap(ego[:, 2])
    ego[standing, 3:] = 0.0
    return ego


def _tracks(
    boxes: "pl.DataFrame", poses: "pl.DataFrame", time_ns: np.ndarray, path: Path
) -> RawTracks:
    """Objects at the grid times, in table order; unseen steps repeat the nearest pose."""
    box_ns, pose_ns = boxes["timestamp_ns"].to_numpy(), poses["timestamp_ns"].to_numpy()
    after = np.clip(np.searchsorted(pose_ns, box_ns), 1, len(pose_ns) - 1)
    before_is_nearer = box_ns - pose_ns[after - 1] < pose_ns[after] - box_ns
    nearest = after - before_is_nearer
    lag = np.abs(pose_ns[nearest] - box_ns)
    if lag.max(initial=0) > POSE_TOLERANCE_NS:
        raise ScenarioError(
            f"{path}: timestamp_ns {box_ns[lag.argmax()]} has no pose in "
            f"city_SE3_egovehicle.feather (nearest is {lag.max() / 1e6:.1f} ms away); "
            "take both tables from the same log"
        )
    city_from_ego, shift = _rotation(poses)[nearest], _xyz(poses)[nearest]
    xy = (np.einsum("nij,nj->ni", city_from_ego, _xyz(boxes)) + shift)[:, :2]
    yaw = _yaw(city_from_ego @ _rotation(boxes))
    size = boxes.select("length_m", "width_m").to_numpy()
    ids, category = boxes["track_uuid"].to_list(), boxes["category"].to_list()

    rows: dict[str, list[int]] = {}
    for i, track in enumerate(ids):
        rows.setdefault(track, []).append(i)
    time, at = (box_ns - time_ns[0]) / 1e9, (time_ns - time_ns[0]) / 1e9
    num = (len(rows), len(at))
    out = RawTracks(
        ids=list(rows),
        type=np.array(
            [CATEGORIES.get(category[r[0]], ObjectType.GENERIC_OBJECT) for r in rows.values()], int
        ),
        pose=np.zeros((*num, 3)),
        velocity=np.zeros((*num, 2)),
        size=np.zeros((*num, 2)),
        valid=np.zeros(num, bool),
    )
    for a, index in enumerate(rows.values()):
        t = time[index]
        if (np.diff(t) <= 0).any():
            raise ScenarioError(
                f"{path}: track_uuid {ids[index[0]]} occurs twice at timestamp_ns "
                f"{box_ns[index][:-1][np.diff(t) <= 0][0]}; remove one of the rows"
            )
        pose = np.column_stack([xy[index], np.unwrap(yaw[index])])
        gap = np.abs(t[:, None] - at)
        near = gap.argmin(0)
        out.valid[a] = gap.min(0) * 1e9 <= SWEEP_TOLERANCE_NS
        velocity = local_derivatives(t, pose[:, :2] - pose[0, :2], at, TRACK_HALF_WINDOW, 1)[0]
        seen = np.clip(at, t[0], t[-1])
        out.pose[a] = np.column_stack([np.interp(seen, t, column) for column in pose.T])
        # A first or last box lies some milliseconds off the grid.
        out.pose[a, :, :2] += out.valid[a, :, None] * (at - seen)[:, None] * velocity
        out.pose[a, :, 2] = _wrap(out.pose[a, :, 2])
        out.size[a] = size[index][near]
        moving = (np.hypot(*velocity.T) >= TRACK_MIN_SPEED) & out.valid[a]
        out.velocity[a] = velocity * (moving & (out.type[a] <= ObjectType.BICYCLE))[:, None]
    return out


def _xyz(table: "pl.DataFrame") -> np.ndarray:
    return table.select("tx_m", "ty_m", "tz_m").to_numpy()


def _rotation(table: "pl.DataFrame") -> np.ndarray:
    """Returns `[N, 3, 3]` rotation matrices of the unit quaternions of a table."""
    w, x, y, z = table.select("qw", "qx", "qy", "qz").to_numpy().T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), 2, 0)


def _yaw(rotation: np.ndarray) -> np.ndarray:
    return np.arctan2(rotation[:, 1, 0], rotation[:, 0, 0])


def _wrap(angle: np.ndarray) -> np.ndarray:
    return (angle + np.pi) % (2 * np.pi) - np.pi
