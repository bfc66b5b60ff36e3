"""From the options of `spdm pack` to the reader that they mean."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from spdm_experiments.options import Format, Pack
from spdm_jax.io.raw import RawScenario, Reader

if TYPE_CHECKING:
    from spdm_jax.interplan.extras import InterplanExtras
    from spdm_jax.interplan.reader import InterplanReader
    from spdm_jax.io.nuplan_filter import ScenarioFilter

AV2_POSES = "city_SE3_egovehicle.feather"
"""The file that every Argoverse 2 sensor log has."""


class Selection:
    """A reader cut down to some of its tokens, in the reader's order."""

    def __init__(self, reader: Reader, wanted: Sequence[str], limit: int | None):
        """Picks the tokens.

        Args:
          reader: the whole source.
          wanted: tokens to keep; empty keeps all.
          limit: at most so many; None for all.

        Raises:
          ValueError: the source lacks a wanted token, selects nothing, or `limit` is no count.
        """
        if limit is not None and limit < 1:
            raise ValueError(f"--limit is {limit}; it must be at least 1")
        tokens = list(reader.tokens())
        if missing := [token for token in wanted if token not in set(tokens)]:
            raise ValueError(
                f"--token {missing[0]}: not in the source ({len(tokens)} scenarios, "
                f"{', '.join(tokens[:3])}, ...)"
            )
        keep = set(wanted or tokens)
        self._reader = reader
        self._tokens = [token for token in tokens if token in keep][:limit]
        if not self._tokens:
            raise ValueError("the source has no scenario that the options select")

    def tokens(self) -> Sequence[str]:
        """Returns the tokens kept."""
        return self._tokens

    def read(self, token: str) -> RawScenario:
        """Reads one scenario; raises what the source's own reader raises."""
        return self._reader.read(token)


class ChangedSelection(Selection):
    """Some of interPlan's scenarios."""

    def __init__(self, reader: "InterplanReader", limit: int | None):
        """Picks the first scenarios; see `Selection`."""
        super().__init__(reader, (), limit)
        self._changed = reader

    def read_with_extras(self, token: str) -> tuple[RawScenario, "InterplanExtras"]:
        """Reads one scenario, changed; raises what the source's own reader raises."""
        return self._changed.read_with_extras(token)


def open_source(options: Pack) -> tuple[Reader, list[str]]:
    """Opens what the options name.

    Returns:
      The reader, cut down to the selected scenarios, and remarks for the user.

    Raises:
      ValueError: the source cannot be recognised or read (`ScenarioError`), or an option does not
        apply to it.
    """
    kind = detect_format(options.source) if options.format == "auto" else options.format
    _refuse_foreign_options(options, kind)
    notes: list[str] = []
    reader: Reader
    if options.interplan is not None:
        changed = _changed(options)
        return ChangedSelection(changed, options.limit), list(changed.notes)
    if kind == "nuplan":
        from spdm_jax.io.nuplan import NuPlanReader

        reader = nuplan = NuPlanReader(options.source, options.maps, _nuplan_filter(options))
        notes = list(nuplan.notes)
        wanted: Sequence[str] = ()  # the filter has the tokens
    elif kind == "av2":
        from spdm_jax.io.av2 import AV2Reader

        stride = options.stride
        reader = (
            AV2Reader(options.source)
            if stride is None
            else AV2Reader(options.source, stride_s=stride)
        )
        wanted = options.token
    else:
        reader = _built_in(options)
        wanted = options.token
    return Selection(reader, wanted, options.limit), notes


def detect_format(source: str) -> Format:
    """Tells the format by the files at `source`, or that it lists built-in scenes.

    Raises:
      ValueError: nothing known is there.
    """
    path = Path(source)
    if path.is_file() and path.suffix == ".db":
        return "nuplan"
    if path.is_dir():
        if (path / AV2_POSES).is_file() or any(path.glob(f"*/{AV2_POSES}")):
            return "av2"
        if any(path.rglob("*.db")):
            return "nuplan"
        raise ValueError(f"{source}: no nuPlan log (.db) and no Argoverse 2 log ({AV2_POSES})")
    if path.exists():
        raise ValueError(f"{source}: not a nuPlan log (.db) and not a folder; name --format")
    from spdm_jax.synthetic import scene_names
    from spdm_jax.synthetic.suites import suite_names

    names = [*scene_names(), *suite_names()]
    if source == "all" or set(_split(source)) & set(names):
        return "synthetic"
    raise ValueError(
        f"{source}: no such file or folder, and no built-in scene or suite; there are "
        f"{', '.join(names)}"
    )


def _built_in(options: Pack) -> Reader:
    """Opens a suite, or built-in scenes."""
    from spdm_jax.synthetic import SyntheticReader
    from spdm_jax.synthetic.suites import SuiteReader, suite_names

    if options.source in suite_names():
        given = options.seeds != Pack.seeds
        return SuiteReader(options.source, options.seeds) if given else SuiteReader(options.source)
    return SyntheticReader(_scene_names(options.source), options.seeds)


def _scene_names(source: str) -> list[str]:
    from spdm_jax.synthetic import scene_names

    names = list(scene_names())
    wanted = names if source == "all" else _split(source)
    if unknown := [name for name in wanted if name not in names]:
        raise ValueError(f"no scene {unknown[0]!r}; the scenes are {', '.join(names)}")
    return wanted


def _split(source: str) -> list[str]:
    return [name.strip() for name in source.split(",") if name.strip()]


def _refuse_foreign_options(options: Pack, kind: Format) -> None:
    """Raises ValueError for an option that the source would silently ignore."""
    owner = {
        "maps": "nuplan",
        "filter": "nuplan",
        "interplan": "nuplan",
        "type": "nuplan",
        "log": "nuplan",
        "stride": "av2",
        "seeds": "synthetic",
    }
    for field in dataclasses.fields(options):
        given = getattr(options, field.name) != field.default
        if given and owner.get(field.name, kind) != kind:
            raise ValueError(
                f"--{field.name} applies to {owner[field.name]} sources, {options.source} is {kind}"
            )


def _changed(options: Pack) -> "InterplanReader":
    """Opens interPlan's scenarios.

    Raises:
      ValueError: a file cannot be used, or the options select no scenario.
    """
    from spdm_jax.interplan.modification_file import read_modifications
    from spdm_jax.interplan.reader import InterplanReader

    assert options.interplan is not None
    config = read_modifications(options.interplan)
    chosen = _nuplan_filter(options)
    names = chosen.scenario_tokens or ()
    # nuPlan's tags know nothing of the types that changes make.
    if chosen.scenario_types is not None:
        types = {name: config.changes(name).scenario_type for name in names if "-" in name}
        if unknown := [name for name in chosen.scenario_types if name not in types.values()]:
            known = ", ".join(sorted(set(types.values())))
            raise ValueError(f"--type {unknown[0]}: no scenario of it; there are {known}")
        names = [name for name in types if types[name] in chosen.scenario_types]
        chosen = dataclasses.replace(chosen, scenario_tokens=names, scenario_types=None)
    return InterplanReader(options.source, config, chosen, options.maps)


def _nuplan_filter(options: Pack) -> "ScenarioFilter":
    from spdm_jax.io.nuplan_filter import ScenarioFilter

    chosen = ScenarioFilter.from_yaml(options.filter) if options.filter else ScenarioFilter()
    given = {
        "scenario_tokens": options.token,
        "scenario_types": options.type,
        "log_names": options.log,
    }
    return dataclasses.replace(chosen, **{name: value for name, value in given.items() if value})
