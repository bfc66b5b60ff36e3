"""What reports and tables call the scored metrics of a simulation."""

from typing import Final

CLOSED: Final = {
    "no_ego_at_fault_collisions": ("No at-fault collision", "NC"),
    "drivable_area_compliance": ("Drivable area", "DAC"),
    "ego_is_making_progress": ("Making progress", "MP"),
    "driving_direction_compliance": ("Driving direction", "DDC"),
    "ego_progress_along_expert_route": ("Progress along the expert's route", "EP"),
    "time_to_collision_within_bound": ("Time to collision", "TTC"),
    "speed_limit_compliance": ("Speed limit", "SL"),
    "ego_is_comfortable": ("Comfort", "C"),
}
OPEN: Final = {
    "planner_miss_rate_within_bound": ("Miss rate", "MR"),
    "planner_expert_average_l2_error_within_bound": ("Average displacement", "ADE"),
    "planner_expert_final_l2_error_within_bound": ("Final displacement", "FDE"),
    "planner_expert_average_heading_error_within_bound": ("Average heading error", "AHE"),
    "planner_expert_final_heading_error_within_bound": ("Final heading error", "FHE"),
}
INTERPLAN: Final = {
    "interplan_score": ("interPlan's score", "iP"),
    "lane_changes_to_goal": ("Lane changes to the goal", "LC"),
    "ego_sorts_construction_zone": ("Gets past the construction zone", "CZ"),
    "ego_sorts_stopped_vehicle": ("Gets past stopped vehicles", "SV"),
    "ego_sorts_jaywalking_pedestrian": ("Gets past jaywalkers", "JW"),
}
"""Null for every other scenario."""
_ALL: Final = {**CLOSED, **OPEN, **INTERPLAN}
TITLES: Final = {name: title for name, (title, _) in _ALL.items()}
SHORT: Final = {name: short for name, (_, short) in _ALL.items()}
