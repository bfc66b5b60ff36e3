"""The way of every verb that fills a folder with what it computes of many scenarios.

Describe the folder, or check that it holds the same; see what is done; compute the rest chunk by
chunk, each written as a part; stop between chunks; say how it stands. A verb says what its folder
and its chunks are (`Verb`).
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from spdm_experiments.inventory import Inventory, Shard, take_inventory
from spdm_experiments.parts import part_name
from spdm_experiments.run_folder import Progress, alone, note
from spdm_experiments.runtime import stop_after
from spdm_experiments.terminal import RateLine, print_files, reasons
from spdm_experiments.work import Done
from spdm_jax import Failure
from spdm_jax.io.raw import ScenarioError


class Verb(ABC):
    """What a verb brings to the sequence.

    Attributes:
      folder: of the run.
      rows: file or folder that lists all reasons.
      origin: versions, commit and device of the processes that compute.
      serial: nothing is computed while something compiles.
    """

    folder: Path
    rows: Path
    origin: dict[str, object]
    serial = True

    @abstractmethod
    def open(self) -> list[str]:
        """Describes the folder or checks it; returns what the user should know.

        Raises:
          ValueError: the folder holds something else.
        """

    @abstractmethod
    def clean(self, shard: Shard) -> None:
        """Removes what killed processes of a shard left half done."""

    @abstractmethod
    def read_done(self) -> tuple[dict[str, str], list[str]]:
        """Returns token -> reason ("" where all is well) of what is done, and notes."""

    @abstractmethod
    def write_unusable(self, name: str, failures: Sequence[Failure]) -> None:
        """Writes the part of scenarios whose files cannot be used."""

    @abstractmethod
    def run(self, shard: Shard, missing: set[str], stop: Callable[[], bool]) -> Iterator[Done]:
        """Computes what is missing, chunk by chunk, until the user wants to stop."""

    def finish(self) -> None:  # noqa: B027 - most verbs have nothing left to do
        """Does what comes after the last scenario, in a process that does not only see a shard."""

    @abstractmethod
    def tell(self) -> None:
        """Prints the results so far."""


@dataclass
class Tally:
    """What is done, and what of it by this process.

    Attributes:
      reasons: token -> reason, "" where all is well, of every scenario of the shard that is done.
      scenarios: done here.
      programs: made here.
      seconds: spent here, by what on.
      messages: what the user was told.
    """

    reasons: dict[str, str]
    scenarios: int = 0
    programs: int = 0
    seconds: dict[str, float] = field(default_factory=dict)
    messages: list[str] = field(default_factory=list)

    def take(self, done: Done) -> None:
        """Adds a chunk."""
        self.reasons |= done.reasons
        self.scenarios += len(done.reasons)
        self.programs += done.programs
        for name, value in done.seconds.items():
            self.seconds[name] = self.seconds.get(name, 0.0) + value
        self.messages += done.messages
        note(done.messages)

    def counts(self, total: int) -> dict[str, Any]:
        """Returns how far the shard is."""
        return {
            "scenarios": total,
            "done": len(self.reasons),
            "failed": sum(bool(reason) for reason in self.reasons.values()),
            "finished": len(self.reasons) == total,
        }

    def work(self) -> dict[str, Any]:
        """Returns what was done here."""
        seconds = {f"{name}_s": round(value, 3) for name, value in self.seconds.items()}
        counts = {"scenarios": self.scenarios, "programs": self.programs}
        return {**counts, **seconds, "messages": self.messages}


def usable_inventory(files: Sequence[Path], source: object) -> Inventory:
    """Looks through scenario files.

    Raises:
      ScenarioError: none of them can be used.
    """
    inventory = take_inventory(files)
    if not inventory.entries:
        raise ScenarioError(f"{source}: no usable scenario: {inventory.failures[0].reason}")
    return inventory


def go_on(verb: Verb, inventory: Inventory, shard: Shard) -> bool:
    """Computes what a folder still lacks; returns False if a scenario of the shard failed.

    Args:
      verb: what is computed.
      inventory: all scenarios.
      shard: which of them are this process's.

    Raises:
      ValueError: the folder holds something else, or another process is at work on it.
      KeyboardInterrupt: the user stopped it; the folder can be gone on with.
    """
    note(verb.open())
    with alone(verb.folder, shard):
        verb.clean(shard)
        done, notes = verb.read_done()
        note(notes)
        tokens = [e.token for e in inventory.entries] + [f.token for f in inventory.failures]
        mine = {token for token in tokens if shard.holds(token)}
        tally = Tally({token: reason for token, reason in done.items() if token in mine})
        missing = mine - tally.reasons.keys()
        if missing:
            _note_unusable(verb, inventory, shard, missing, tally)
            _work(verb, shard, missing, tally, len(mine))
            verb.clean(shard)  # what lost workers of a cluster left
        if shard.index == 1 and tally.counts(len(mine))["finished"]:
            verb.finish()
        return _close(verb, shard, tally, len(mine), bool(missing))


def _note_unusable(
    verb: Verb, inventory: Inventory, shard: Shard, missing: set[str], tally: Tally
) -> None:
    failures = [failure for failure in inventory.failures if failure.token in missing]
    if failures:
        name = part_name(shard.name, "unusable", [failure.token for failure in failures])
        verb.write_unusable(name, failures)
        tally.take(Done(name, {failure.token: failure.reason for failure in failures}))


def _work(verb: Verb, shard: Shard, missing: set[str], tally: Tally, total: int) -> None:
    progress = Progress(verb.folder, shard, verb.origin)
    before = len(tally.reasons) - tally.scenarios
    line = RateLine(total, before)
    with stop_after("chunk") as stopping:
        line.show(len(tally.reasons), 0.0, 0, 0.0)
        progress.save(tally.counts(total), tally.work())
        for done in verb.run(shard, missing - tally.reasons.keys(), stopping):
            tally.take(done)
            progress.save(tally.counts(total), tally.work())
            compile_s = tally.seconds.get("compile", 0.0)
            waited = compile_s if verb.serial else 0.0
            line.show(len(tally.reasons), compile_s, tally.programs, waited)
    line.close()


def _close(verb: Verb, shard: Shard, tally: Tally, total: int, worked: bool) -> bool:
    """Prints the outcome.

    Raises:
      KeyboardInterrupt: scenarios are missing because the user stopped the run.
    """
    counts = tally.counts(total)
    verb.tell()
    whose = "" if shard.count == 1 else f" of shard {shard.index}/{shard.count}"
    if counts["finished"] and not worked:
        print(f"all {total} scenarios{whose} were done already, {counts['failed']} failed")
    else:
        print(f"{counts['done']} of {total} scenarios{whose} done, {counts['failed']} failed")
        print(", ".join(f"{name} {value:.1f} s" for name, value in tally.seconds.items()))
    failed = {token: reason for token, reason in tally.reasons.items() if reason}
    for reason in reasons(failed, verb.rows):
        print(reason)
    print_files([verb.folder])
    if not counts["finished"]:
        raise KeyboardInterrupt
    return not counts["failed"]
