"""What NAVSIM's scores do otherwise than PDM-Closed's, one rule at a time, through the chain."""

from functools import cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from navsim_frame import (
    AREAS,
    BLOCK,
    LENGTH,
    REACH,
    STEPS,
    driving,
    frame,
    logged,
    straight,
)
from spdm_jax.navsim.batch import stack, to_device
from spdm_jax.navsim.build import from_arrays
from spdm_jax.navsim.score import score_states, score_trajectories
from spdm_jax.navsim.types import NavsimScores
from spdm_jax.scoring.profile import NAVSIM1, NAVSIM2, TUPLAN, Profile

ROWS = 4  # trajectories of every call, so that there is one program per profile
STATIC = 4  # a barrier
FRONT = REACH + 0.5 * LENGTH
PROFILES = (NAVSIM1, NAVSIM2)


@cache
def program(profile: Profile):
    return jax.jit(lambda scene, poses: score_trajectories(scene, poses, profile))


def score(arrays: dict[str, Any], profile: Profile, *poses: np.ndarray) -> NavsimScores:
    """Scores up to four trajectories (10 m/s straight on if there are none)."""
    rows = [*(poses or (straight(10.0),))]
    rows += [straight(10.0)] * (ROWS - len(rows))
    scene = to_device(from_arrays(arrays), jnp.float64)
    scored = program(profile)(scene, jnp.asarray(np.stack(rows)))
    return jax.tree.map(np.asarray, scored)


def test_a_clean_drive_is_perfect():
    for profile in PROFILES:
        scored = score(frame(), profile)
        np.testing.assert_allclose(scored.total, 1, atol=1e-6)
        assert scored.collision_index[0] == scored.ttc_index[0] == STEPS
        assert scored.total.dtype == np.float64


def test_progress_compares_with_the_reference_alone():
    for profile in PROFILES:
        slow = score(frame(reference_speed=5.0), profile, straight(3.0), straight(9.0))
        fast = score(frame(reference_speed=5.0), profile, straight(3.0), straight(10.0))
        assert fast.progress_raw[1] > slow.progress_raw[1] > 30
        assert slow.raw.progress[1] == fast.raw.progress[1] == 1
        assert slow.total[0] == fast.total[0]
        assert 0.5 < slow.raw.progress[0] < 1
        base = score(frame(reference_speed=10.0), profile, straight(3.0))
        assert base.raw.progress[0] < slow.raw.progress[0]


def test_little_progress_counts_as_full_up_to_five_metres():
    creep = frame(speed=1.0, reference_speed=1.2)
    for profile in PROFILES:
        scored = score(creep, profile, straight(0.6))
        assert 1 < scored.progress_raw[0] < 4
        assert scored.raw.progress[0] == 1


def test_only_v1_puts_the_multiplier_into_progress():
    # A barrier in the way: half the collision score, in v1 half the progress as well.
    hit = frame(logged(FRONT + 35, kind=STATIC), reference_speed=1.0)
    first, second = (score(hit, profile) for profile in PROFILES)
    for scored in (first, second):
        assert scored.raw.no_at_fault_collision[0] == 0.5
        assert scored.raw.time_to_collision[0] == 0
    assert first.raw.progress[0] == 1  # relative to itself, multiplied on both sides
    faster = frame(logged(FRONT + 37, kind=STATIC), reference_speed=8.0)
    first, second = (score(faster, profile, straight(9.5)) for profile in PROFILES)
    share = first.progress_raw[0] / score(faster, NAVSIM1, straight(8.0)).progress_raw[0]
    assert second.raw.progress[0] == 1
    assert first.raw.progress[0] == pytest.approx(0.5 * share, abs=0.02)
    assert first.total[0] == pytest.approx(0.5 * (5 * first.raw.progress[0] + 2) / 12)


def test_an_object_recorded_once_stands_there_all_the_time():
    # Recorded at 4.0 s only; the ego is there after 2.5 s.
    once = frame(logged(FRONT + 24.5 + 2.0, frames=8))
    for profile in PROFILES:
        scored = score(once, profile)
        assert scored.raw.no_at_fault_collision[0] == 0
        assert scored.collision_index[0] == 25
    # Recorded from 4.0 s on: v1 sees it appear, v2 has one frame left and lets it stand.
    late = frame(logged(FRONT + 34.5 + 2.0, frames=slice(8, None)))
    assert score(late, NAVSIM1).collision_index[0] == 40
    assert score(late, NAVSIM2).collision_index[0] == 35


def test_gaps_in_the_record_are_bridged():
    gap = driving(FRONT + 60, -8.0, frames=[0, 1, 9, 10])
    for profile, whole in ((NAVSIM1, gap), (NAVSIM2, driving(FRONT + 60, -8.0, frames=[0, 1, 8]))):
        without = score(frame(driving(FRONT + 60, -8.0)), profile)
        assert score(frame(whole), profile).collision_index[0] == without.collision_index[0] < STEPS


def test_objects_are_where_they_are_at_each_tenth_of_a_second():
    # Closing at 15 m/s; the bumpers meet between 2.6 s and 2.7 s.
    gap = 15 * 2.65
    scored = score(frame(driving(FRONT + gap + 2.0, -5.0)), NAVSIM1)
    assert scored.collision_index[0] == 27


def test_the_first_speed_tells_who_stands():
    def rammed(first_speed: float) -> np.ndarray:
        # From behind at 20 m/s; the record starts with some speed of its own.
        car = driving(-25.0, 20.0)
        car["velocity"][0] = (first_speed, 0)
        return score(frame(car), NAVSIM2).raw.no_at_fault_collision

    assert rammed(20.0)[0] == 1  # hit from behind: not at fault
    assert rammed(0.0)[0] == 0  # a car that stood is always the ego's fault


def test_objects_at_the_ego_count_in_v1_and_are_gone_in_v2():
    inside = frame(logged(3.0, 1.5))
    assert score(inside, NAVSIM1).raw.no_at_fault_collision[0] == 0
    assert score(inside, NAVSIM1).collision_index[0] == 0
    second = score(inside, NAVSIM2)
    assert second.raw.no_at_fault_collision[0] == second.raw.time_to_collision[0] == 1
    # One that is recorded later only is not at the start.
    later = frame(logged(3.0, 1.5, frames=[3, 4, 5]))
    assert score(later, NAVSIM2).valid[0]
    moved = frame(logged(FRONT + 27.0, frames=[3, 4, 5, 6, 7, 8]))
    assert score(moved, NAVSIM2).raw.no_at_fault_collision[0] == 0


def test_v2_looks_for_collisions_to_come_up_to_3_1_s():
    # At 10 m/s the box, 0.9 s ahead, reaches the car from 3.5 s on; the ego itself never does.
    ahead = frame(logged(FRONT + 43.9 + 2.0))
    first, second = (score(ahead, profile) for profile in PROFILES)
    assert first.raw.no_at_fault_collision[0] == second.raw.no_at_fault_collision[0] == 1
    assert first.ttc_index[0] == 35
    assert second.ttc_index[0] == STEPS
    nearer = score(frame(logged(FRONT + 39.9 + 2.0)), NAVSIM2)
    assert nearer.ttc_index[0] == 31
    # Gaining speed, the ego looks 54.1 m far at 3.1 s, 54.4 m at 3.4 s, and arrives at 54.6 m.
    gaining = straight(10.0)
    gaining[:, 0] += (0.5 * np.arange(1, 9)) ** 2
    late = score(frame(logged(FRONT + 54.3 + 2.0)), NAVSIM2, gaining)
    assert late.ttc_index[0] == STEPS
    assert late.collision_index[0] == 40


def test_blocks_and_intersections_are_drivable_and_lanes_are_not():
    for profile in PROFILES:
        right = score(frame(y=-3.5), profile)  # in a lane that no block covers
        assert right.raw.drivable_area[0] == 0
        # Beyond the block, but inside the intersection.
        assert score(frame(x=62, y=8.0, speed=1.0), profile, straight(1.0)).raw.drivable_area[0]
        assert not score(frame(x=50, y=8.0, speed=1.0), profile, straight(1.0)).raw.drivable_area[0]


def test_lanes_not_blocks_make_multiple_lanes():
    between = score(frame(y=1.7), NAVSIM1)
    assert between.multiple_lanes[0].all()
    assert not score(frame(), NAVSIM1).multiple_lanes[0].any()
    # Two blocks across one lane do not.
    split = ((BLOCK, False, (-60, -1.75, 140, 0)), (BLOCK, False, (-60, 0, 140, 5.25)), *AREAS[1:])
    parted = score(frame(y=0.2, areas=split), NAVSIM1)
    assert not parted.multiple_lanes[0].any()
    assert not parted.non_drivable[0].any()


def test_driving_against_the_traffic():
    against = frame(y=3.5)
    first, second = (score(against, profile) for profile in PROFILES)
    assert first.raw.driving_direction[0] == second.raw.driving_direction[0] == 0
    assert first.total[0] == pytest.approx(1)  # no weight in v1
    assert second.total[0] == 0
    # Inside an intersection v2 looks away, v1 does not.
    crossing = frame(x=61.0, y=3.5, speed=4.0, reference_speed=4.0)
    first, second = (score(crossing, profile, straight(4.0)) for profile in PROFILES)
    assert first.raw.driving_direction[0] == 0.5
    assert second.raw.driving_direction[0] == 1


def test_red_lights_stop_v2_alone():
    red = frame(red=slice(None))
    assert score(red, NAVSIM1).total[0] == pytest.approx(1)
    second = score(red, NAVSIM2)
    assert second.raw.traffic_light[0] == second.total[0] == 0
    # The bumper reaches the connector at x = 20 m.
    assert second.red_light_index[0] == int(np.ceil((20 - FRONT) / 1.0))
    # A status holds for half a second: red in frame 2 is red from 1.0 to 1.4 s.
    assert score(frame(red=2), NAVSIM2).raw.traffic_light[0] == 1
    assert score(frame(red=3), NAVSIM2).red_light_index[0] == 16
    # Who starts inside touches it too.
    inside = score(frame(x=22.0, red=0), NAVSIM2, straight(0.5))
    assert inside.red_light_index[0] == 0


def test_v2_remembers_how_the_ego_drove():
    harsh = frame(past_accel=-6.0)
    first, second = (score(harsh, profile) for profile in PROFILES)
    assert first.raw.comfort[0] == 1
    assert second.raw.comfort[0] == 0
    assert not second.comfort_flags[0, 0]
    without = {name: v for name, v in harsh.items() if not name.startswith("ego_past")}
    unknown = score(without, NAVSIM2)
    assert unknown.raw.comfort[0] == 1
    assert unknown.comfort_flags.all()


def test_the_previous_plan_counts_where_there_is_one():
    plain = score(frame(), NAVSIM2)
    assert not plain.has_extended_comfort
    weave = straight(10.0) + np.array([0, 0.6, 0.3]) * (-1.0) ** np.arange(8)[:, None]
    same = {
        **frame(),
        "prev_poses": straight(10.0),
        "prev_start_time_us": frame()["ego_past_us"][2],
    }
    agreed, broken = (score(arrays, NAVSIM2) for arrays in (same, {**same, "prev_poses": weave}))
    assert agreed.has_extended_comfort
    assert agreed.raw.extended_comfort[0] == 1
    assert broken.raw.extended_comfort[0] == 0
    assert broken.total[0] == pytest.approx(14 / 16)
    assert broken.total_without_extended_comfort[0] == plain.total[0] == pytest.approx(1)
    # v1 does not look at it.
    first = score({**same, "prev_poses": weave}, NAVSIM1)
    assert not first.has_extended_comfort
    assert first.total[0] == pytest.approx(1)


def test_nobody_is_held_to_what_the_human_failed():
    against = frame(y=3.5)
    human = {**against, "human_poses": straight(10.0)}
    scored, without = score(human, NAVSIM2), score(against, NAVSIM2)
    assert scored.human.driving_direction == scored.human.lane_keeping == 0
    assert scored.human.comfort == scored.human.progress == 1
    assert scored.raw.driving_direction[0] == 0
    assert scored.filtered.driving_direction[0] == scored.filtered.lane_keeping[0] == 1
    assert scored.total[0] == pytest.approx(1)
    assert scored.total_unfiltered[0] == without.total[0] == 0
    assert without.human.driving_direction == 1
    # Half a failure of the human's excuses nobody; v1 has no filter.
    hit = {**frame(logged(FRONT + 37, kind=STATIC)), "human_poses": straight(10.0)}
    half = score(hit, NAVSIM2)
    assert half.human.no_at_fault_collision == half.filtered.no_at_fault_collision[0] == 0.5
    assert half.filtered.time_to_collision[0] == 1
    assert score(hit, NAVSIM1).filtered.time_to_collision[0] == 0


def test_frames_need_a_profile_of_navsim():
    scene = to_device(from_arrays(frame()), jnp.float64)
    with pytest.raises(ValueError, match="profile is tuplan"):
        score_states(scene, jnp.zeros((1, STEPS, 11)), TUPLAN)


def test_a_trajectory_that_is_not_finite_fails_alone():
    broken, huge = straight(8.0), straight(8.0)
    broken[3, 1] = np.nan
    huge[:] = 1e200
    arrays = {**frame(logged(FRONT + 40)), "human_poses": straight(9.0)}
    for profile in PROFILES:
        whole = score(arrays, profile, straight(8.0), straight(8.0), straight(6.0), straight(7.0))
        scored = score(arrays, profile, broken, straight(8.0), huge, straight(7.0))
        assert scored.valid.tolist() == [False, True, False, True]
        for values, others in zip(jax.tree.leaves(scored), jax.tree.leaves(whole), strict=True):
            assert np.isfinite(values).all()
            if values.ndim:
                np.testing.assert_array_equal(values[1::2], others[1::2])
        for terms in (scored.raw, scored.filtered):
            assert not any(terms_of[0] for terms_of in jax.tree.leaves(terms))
        assert scored.total[0] == scored.total[2] == scored.progress_raw[0] == 0


@pytest.mark.slow
def test_batches_and_padding_change_nothing():
    crowd = [logged(FRONT + 44, 3.6 * (i % 2) + 0.1 * i) for i in range(17)]
    many = {
        **frame(*crowd, red=slice(0, 4)),
        "human_poses": straight(9.0),
        "prev_poses": straight(9.0),
        "prev_start_time_us": frame()["ego_past_us"][2],
    }
    frames = [from_arrays(many), from_arrays(frame(driving(FRONT + 41.8, -5.0), y=0.4))]
    assert frames[0].objects.x.shape != frames[1].objects.x.shape
    poses = np.stack([straight(speed) for speed in (10.0, 8.0, 12.0, 5.0)])
    together = to_device(stack(frames), jnp.float64)
    whole = together.replace(origin=np.zeros((2, 2)), start_time_us=np.zeros(2, np.int64))
    batched = jax.jit(jax.vmap(lambda s: score_trajectories(s, jnp.asarray(poses), NAVSIM2)))(whole)
    for row, single in enumerate(frames):
        alone = program(NAVSIM2)(to_device(single, jnp.float64), jnp.asarray(poses))
        for ours, theirs in zip(jax.tree.leaves(batched), jax.tree.leaves(alone), strict=True):
            np.testing.assert_allclose(ours[row], theirs, atol=1e-12)
