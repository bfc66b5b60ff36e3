"""The scenarios of `spdm simulate`: a built-in suite, packed once, or files that are there."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path

from spdm_experiments.chunks import scenario_files, suite_name
from spdm_experiments.inventory import Inventory
from spdm_experiments.options import Simulate
from spdm_experiments.packed_suites import packed_suite
from spdm_experiments.sequence import usable_inventory
from spdm_experiments.simulate_scripts import Extras, find_extras
from spdm_jax import Failure
from spdm_jax.synthetic import suites


@dataclasses.dataclass(frozen=True)
class Scenes:
    """Scenarios of a run.

    Attributes:
      suite: what they are, for people.
      folder: where their files lie.
      inventory: those selected.
      extras: of interPlan's scenarios among them.
    """

    suite: str
    folder: Path
    inventory: Inventory
    extras: Extras


def find_scenes(options: Simulate) -> Scenes:
    """Returns the scenarios that the options name; packs a suite that is not packed yet.

    Raises:
      ValueError: there is no such suite or folder, or nothing is left of it.
    """
    name = str(options.scenes)
    if options.limit is not None and options.limit < 1:
        raise ValueError(f"--limit is {options.limit}; it must be at least 1")
    if name in suites.suite_names() and not options.scenes.exists():
        folder, files = _packed_suite(name, options)
        return Scenes(name, folder, _drivable(usable_inventory(files, name)), {})
    try:
        # Types are known after a look at the files only, and the limit is one of those selected.
        files = scenario_files(options.scenes, None if options.types else options.limit)
    except ValueError as error:
        names = ", ".join(suites.suite_names())
        raise ValueError(f"{error}. The built-in suites are {names}") from error
    inventory = usable_inventory(files, options.scenes)
    if options.types:
        inventory = _of_types(inventory, options)
    sources = sorted({entry.source for entry in inventory.entries})
    inventory, extras = find_extras(_drivable(inventory))
    return Scenes(suite_name(options.scenes, sources), options.scenes, inventory, extras)


def _of_types(inventory: Inventory, options: Simulate) -> Inventory:
    """Keeps some types; what cannot be read might be one of them and is kept as well."""
    entries = [entry for entry in inventory.entries if entry.scenario_type in options.types]
    known = sorted({entry.scenario_type for entry in inventory.entries})
    _check_types(options.types, known)
    return dataclasses.replace(inventory, entries=entries[: options.limit])


def _check_types(wanted: Sequence[str], known: Sequence[str]) -> None:
    if missing := [name for name in wanted if name not in known]:
        raise ValueError(f"--types {missing[0]}: no scenario of it; there are {', '.join(known)}")


def _drivable(inventory: Inventory) -> Inventory:
    """Lists scenarios that are but one moment as failures."""
    short = [entry for entry in inventory.entries if entry.num_iterations < 2]
    reason = "its window has 1 iteration, which is no drive; pack it with a longer one"
    return dataclasses.replace(
        inventory,
        entries=[entry for entry in inventory.entries if entry.num_iterations >= 2],
        failures=[*inventory.failures, *(Failure(entry.token, reason) for entry in short)],
    )


def _packed_suite(name: str, options: Simulate) -> tuple[Path, list[Path]]:
    """Returns folder and files of the wanted scenes of a suite; makes those that are missing."""
    _check_types(options.types, list(suites.SUITES[name]))
    reader = suites.SuiteReader(name)
    wanted = set(options.types) or set(suites.SUITES[name])
    tokens = [token for token in reader.tokens() if token.rpartition("-")[0] in wanted]
    tokens = tokens[: options.limit]
    folder = packed_suite(reader, name, tokens)
    return folder, [folder / f"{token}.npz" for token in tokens]
