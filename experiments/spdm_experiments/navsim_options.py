"""Options of the verbs that know NAVSIM's profiles."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg

from spdm_experiments.option_bases import Common

ProfileName = Literal["tuplan", "navsim1", "navsim2", "navsim2_unfiltered"]


@dataclass(frozen=True, kw_only=True)
class Profiled:
    """Options of the verbs that score given trajectories."""

    profile: ProfileName = "tuplan"
    """Whose score: tuplan_garage's (PDM-Closed), NAVSIM v1's PDMS, v2's EPDMS, or v2's without the
    human filter. NAVSIM's take frames exported from NAVSIM as well (see docs/navsim.md); --tracker,
    --forecast and --progress-reference do not apply to them."""
    dt: float | None = None
    """Spacing of the poses, s; 0.1 if left out, with NAVSIM's profiles 0.5 for 8 poses."""


@dataclass(frozen=True, kw_only=True)
class WithPrevious(Profiled):
    """Options of spdm score."""

    previous: Path | None = None
    """Plans of the frame before, for navsim2: a .npz file of "tokens" [S] and "trajectories"
    [S, 8, 3] or [S, P, 8, 3], in the ego frame of that frame. Frames that it does not name go
    without extended comfort."""


@dataclass(frozen=True, kw_only=True)
class NavsimScript(Common):
    """Write the script that exports NAVSIM's metric caches.

    Run it with the Python of your NAVSIM installation: python DST METRIC_CACHE OUT.
    """

    destination: Annotated[Positional[Path], arg(metavar="DST")] = Path("navsim_export.py")
    """File to write."""
