"""A set of NAVSIM frames on the host, with what is known of each in words."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from spdm_jax.navsim.batch import stack
from spdm_jax.navsim.types import NavsimScene
from spdm_jax.results import Failure
from spdm_jax.scoring.profile import Profile

FIRST = ("navsim1",)
SECOND = ("navsim2", "navsim2_unfiltered")


@dataclass(frozen=True)
class NavsimInfo:
    """What a frame says in words; stays on the host.

    Attributes:
      token: identifier, unique within a set.
      log_name: source log, "" where the source does not tell.
      source: "NAVSIM v1" or "NAVSIM v2" for an export, else the reader of the scenario.
      profiles: names of the profiles that the frame has everything for.
    """

    token: str
    log_name: str
    source: str
    profiles: tuple[str, ...]


@dataclass
class NavsimSet:
    """Frames ready to be scored.

    Attributes:
      frames: NumPy leaves, float64; where the frame has a past, `previous` is a plan of zeros made
        one frame earlier.
      infos: one per frame.
      failures: frames that could not be used.
    """

    frames: list[NavsimScene]
    infos: list[NavsimInfo]
    failures: list[Failure] = field(default_factory=list)
    _stacked: NavsimScene | None = field(default=None, init=False, repr=False, compare=False)

    def __len__(self) -> int:
        return len(self.infos)

    def __repr__(self) -> str:
        sources = ", ".join(sorted({info.source for info in self.infos}))
        failed = f"; {len(self.failures)} failed, see .failures" if self.failures else ""
        return f"NavsimSet({len(self)} frames, {sources}{failed})"

    @property
    def tokens(self) -> list[str]:
        """Of the frames, in their order."""
        return [info.token for info in self.infos]

    def stacked(self) -> NavsimScene:
        """Returns all frames padded to one shape, `[B, ...]`, for the device; made once.

        Time stamps are left out: they were put to use when the frames were built.
        """
        if self._stacked is None:
            none = np.zeros(len(self), np.int32)
            self._stacked = stack(self.frames).replace(start_time_us=none)
        return self._stacked

    def select(self, rows: Sequence[int]) -> NavsimSet:
        """Returns some of the frames, in the order of `rows`, without the failures."""
        return NavsimSet([self.frames[i] for i in rows], [self.infos[i] for i in rows])

    def serving(self, profile: Profile) -> NavsimSet:
        """Returns the frames that have everything for a profile; the others join the failures."""
        good = [profile.name in info.profiles for info in self.infos]
        found = self.select(np.flatnonzero(good).tolist())
        lacking = [Failure(i.token, lack(i, profile)) for i in self.infos if i not in found.infos]
        found.failures += [*self.failures, *lacking]
        return found

    def require(self, profile: Profile) -> None:
        """Refuses a profile that a frame lacks something for.

        Raises:
          ValueError: names the frame, its source and what to do.
        """
        for info in self.infos:
            if profile.name not in info.profiles:
                raise ValueError(f"frame {info.token}: {lack(info, profile)}")


def lack(info: NavsimInfo, profile: Profile) -> str:
    """Says why a frame does not serve a profile, and what to do."""
    able = " and ".join(info.profiles) or "no profile"
    if info.source.startswith("NAVSIM"):
        version = "v1.1" if profile.name in FIRST else "v2.2"
        return (
            f"exported with {info.source}, whose metric cache serves {able}, not {profile.name}; "
            f"export the metric cache of NAVSIM {version}"
        )
    needs = "5 s after" if profile.name in FIRST else "1.5 s before and 4 s after"
    return (
        f"serves {able}, not {profile.name}, which needs a record of {needs} iteration 0. Leave "
        "the scenario out, or pack it with more"
    )
