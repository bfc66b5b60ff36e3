"""Colours and words that figure and page share.

Scores run along a dark-to-light scale whose lightness rises evenly, so that it survives colour
blindness and a black-and-white printer; its light end stops short of the colour of the road.
Object colours stay apart under the common colour-vision deficiencies.
"""

from typing import Final

from spdm_jax.types import ObjectType

SCORE_COLORS: Final = (
    "#440154",
    "#482777",
    "#3f4a8a",
    "#31678e",
    "#26838f",
    "#1f9d8a",
    "#36b677",
    "#6cc654",
    "#a5d234",
)
"""Evenly spaced stops from score 0 to 1."""
NO_SCORE_COLOR: Final = "#8a8f98"
"""A score that is not a number."""

OBJECT_COLORS: Final = {
    ObjectType.VEHICLE: "#7d94ac",
    ObjectType.PEDESTRIAN: "#d55e00",
    ObjectType.BICYCLE: "#c060a1",
    ObjectType.TRAFFIC_CONE: "#f0a202",
    ObjectType.BARRIER: "#8c5a2b",
    ObjectType.CZONE_SIGN: "#f3d250",
    ObjectType.GENERIC_OBJECT: "#b9b4ac",
}
OBJECT_NAMES: Final = {
    ObjectType.VEHICLE: "vehicle",
    ObjectType.PEDESTRIAN: "pedestrian",
    ObjectType.BICYCLE: "bicycle",
    ObjectType.TRAFFIC_CONE: "traffic cone",
    ObjectType.BARRIER: "barrier",
    ObjectType.CZONE_SIGN: "work-zone sign",
    ObjectType.GENERIC_OBJECT: "other object",
}

MAP_COLORS: Final = {
    "road": "#e4e7eb",
    "road_edge": "#aab1ba",
    "route": "#c9def2",
    "crosswalk": "#f6f0d0b0",  # see-through: some maps cover whole junctions with one crossing
    "lane": "#ffffff",
    "centerline": "#b3bac3",
    "red": "#d11a2a",
    "ego": "#14213d",
    "failure": "#d11a2a",
    "ink": "#1b1f24",
}

TERMS: Final = {
    "total": "total score",
    "no_at_fault_collision": "no at-fault collision",
    "drivable_area": "drivable area",
    "driving_direction": "driving direction",
    "progress": "progress",
    "time_to_collision": "time to collision",
    "comfort": "comfort",
}
"""Terms of the score that proposals may be coloured by, with their titles."""

RULES: Final = {
    "no_at_fault_collision": "at-fault collision",
    "drivable_area": "leaves the drivable area",
    "driving_direction": "wrong way",
    "time_to_collision": "collision within 1 s",
}
"""Terms that are lost at one moment, with what happens then."""
