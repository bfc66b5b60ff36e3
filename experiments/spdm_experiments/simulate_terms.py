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
TITLES: Final = {name: title for name, (title, _) in {**CLOSED, **OPEN}.items()}
SHORT: Final = {name: short for name, (_, short) in {**CLOSED, **OPEN}.items()}
