"""`popgen COMMAND ...`: the command line.

    parser       the whole command line; each module of commands adds its own part
    run, population, comparison, experiments, bench    the commands, by subject
    guard        a process of its own for `run`
    training     what the commands that train share
    compose      configuration files and overrides: the only file that knows Hydra
    arguments    the parser's class and the types of arguments
    printing     results on stdout
    standard_streams    streams that are closed, full or not read

Whatever a user can get wrong becomes one line on stderr and exit code 2, before Ray starts; torch, Ray and MLflow are
imported only by the commands that need them. Results go to stdout, progress to stderr.
"""

from __future__ import annotations

import errno
import signal
import sys
from collections.abc import Sequence

from popgen.cli.parser import parse
from popgen.cli.printing import ERROR, INTERRUPTED, OK, short
from popgen.cli.standard_streams import drop_results, mend_streams, stdout_is_read
from popgen.errors import UserError
from popgen.runs.interruption import follows_sigterm

_ROOM = "make room or choose another folder; finished parts are kept"
_DISK = {
    errno.ENOSPC: ("the disk is full", _ROOM),
    errno.EDQUOT: ("the disk quota is used up", _ROOM),
    errno.EROFS: ("the file system is read-only", "choose another folder"),
    errno.EACCES: ("permission denied", "choose a folder you can read and write"),
}


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command, that of this process without `argv`; returns the exit code: 0, 2 for an error told in one line,
    130 when interrupted, 15 when ended by SIGTERM."""
    with mend_streams():
        return _run_command(argv)


def _run_command(argv: Sequence[str] | None) -> int:
    try:
        args = parse(sys.argv[1:] if argv is None else list(argv))
        args.own_process = argv is None
        code = args.command(args)
        sys.stdout.flush()
        return code
    except SystemExit as stop:  # --help and --version, and SIGTERM
        if follows_sigterm(stop):
            print("popgen: interrupted by SIGTERM", file=sys.stderr)
            return int(signal.SIGTERM)
        return int(stop.code or 0)
    except UserError as error:
        return _fail(str(error))
    except KeyboardInterrupt:
        print("popgen: interrupted", file=sys.stderr)
        return INTERRUPTED
    except RecursionError:
        return _fail(str(UserError("input", "is nested too deeply", "give plain values")))
    except MemoryError as error:
        return _fail(str(UserError("memory", f"is not enough ({error})", "ask for less at a time")))
    except OSError as error:
        return _fail_of_machine(error)


def _fail_of_machine(error: OSError) -> int:
    """A full disk, a missing right, a path that cannot be: one line. Any other error is ours."""
    if isinstance(error, BrokenPipeError) and not stdout_is_read():  # it takes no more results
        drop_results()
        return OK
    if error.errno not in _DISK and error.filename is None:
        raise error
    where = short(str(error.filename or "disk"))
    problem, fix = _DISK.get(error.errno or 0, (error.strerror or str(error), "check the path"))
    return _fail(str(UserError(where, problem, fix)))


def _fail(message: str) -> int:
    print(f"popgen: error: {short(' '.join(message.split()), 2000)}", file=sys.stderr)
    return ERROR
