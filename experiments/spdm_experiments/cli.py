"""The `spdm` command.

JAX takes a second to import, so it is imported inside the verbs that compute: `spdm --help` and
mistyped options answer at once.
"""

import shlex
import sys
import traceback
from collections.abc import Sequence

import tyro

from spdm_experiments import commands
from spdm_experiments.options import (
    Convert,
    Demo,
    Doctor,
    Label,
    NavsimScript,
    Options,
    Pack,
    Plan,
    Report,
    Score,
    Show,
    Simulate,
    Sweep,
    Vocab,
)
from spdm_experiments.train_options import Train

EXIT_FAILED = 1
"""The command ran, and something in it failed (a scenario, a check)."""
EXIT_ERROR = 2
"""The command could not do its work; also what a mistyped option gives."""
EXIT_INTERRUPTED = 130
"""Ctrl-C."""


def main(argv: Sequence[str] | None = None) -> int:
    """Runs the command line and returns the exit code.

    Args:
      argv: arguments without the program's name; those of the process by default.

    Raises:
      SystemExit: help was asked for, or the options are wrong (code 2).
    """
    options = tyro.cli(
        Options | Train,
        prog="spdm",
        args=argv,
        description="Driving-proposal planning and PDM scoring.",
    )
    try:
        return 0 if run(options) else EXIT_FAILED
    except KeyboardInterrupt:
        resumes = isinstance(options, Pack) and not options.overwrite
        hint = "; the same command goes on where it stopped" if resumes else ""
        if isinstance(options, Label | Simulate | Sweep | Train):
            hint = f"; go on with: spdm {shlex.join(sys.argv[1:] if argv is None else argv)}"
        print(f"spdm: interrupted{hint}", file=sys.stderr)
        return EXIT_INTERRUPTED
    except (ValueError, OSError, ImportError) as error:
        if options.debug:
            traceback.print_exc()
        else:
            print(f"spdm: {_one_line(error)}", file=sys.stderr)
        return EXIT_ERROR


def run(options: Options | Train) -> bool:
    """Runs one verb; returns False if something in it failed."""
    match options:
        case Convert():
            return commands.convert(options)
        case Demo():
            return commands.demo(options)
        case Doctor():
            return commands.doctor(options)
        case Label():
            return commands.label(options)
        case NavsimScript():
            return commands.navsim_script(options)
        case Pack():
            return commands.pack(options)
        case Plan():
            return commands.plan(options)
        case Report():
            return commands.report(options)
        case Score():
            return commands.score(options)
        case Show():
            return commands.show(options)
        case Simulate():
            return commands.simulate(options)
        case Sweep():
            return commands.sweep(options)
        case Train():
            return commands.train(options)
        case Vocab():
            return commands.vocab(options)


def _one_line(error: Exception) -> str:
    if isinstance(error, OSError) and error.filename is not None:
        return f"{error.filename}: {error.strerror}"
    text = " ".join(str(error).split()) or type(error).__name__
    if isinstance(error, ModuleNotFoundError):
        text += '; install the extras: pip install "spdm-jax[data,plot]"'
    return text


if __name__ == "__main__":
    sys.exit(main())
