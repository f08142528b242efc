"""A script and its command line: options that are read and checked, and the folder that it writes to."""

from __future__ import annotations

import io
import json
import re
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, redirect_stderr
from glob import escape
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import tyro

from lab.files import ERRORS
from lab.machine import check_device, facts_of_machine
from lab.options import Options, with_parts
from lab.presets import adapted
from lab.stored_options import check_same, check_typed, of_run, recorded, stored_options
from lab.tasks import (
    resolved_place,
)
from warmprior.io.distributed import from_leader, rank
from warmprior.io.files import check_writable, exclusive, write_atomic
from warmprior.io.script import run_script


def parse[O: Options](
    presets: Mapping[str, O],
    argv: Sequence[str] | None,
    study: str,
    description: str | None,
    adapt: Callable[[O, O], O] = adapted,
) -> O:
    """The options of a command line, checked, with their output folder.

    They start from those of --preset, or with --resume from those stored in the folder, which the command
    line may then only repeat.
    """
    argv = sys.argv[1:] if argv is None else list(map(str, argv))
    asked = read(next(iter(presets.values())), argv, description)
    if asked.run.preset not in presets:
        raise ValueError(f"--preset must be one of {', '.join(presets)}, got {asked.run.preset!r}")
    base = presets[asked.run.preset]
    known = (*argv, *base.sources.prior, *base.data.task)  # no name of a file's
    base = adapt(base, asked)
    if not asked.data.generated:  # the demonstrations of presets are numbers to generate
        base = with_parts(base, data={"demonstrations": ()})
    finished: Path | None = getattr(asked, "policies", None)
    if finished is not None:
        theirs = stored_options(Options, finished, None)
        base = with_parts(
            base,
            **{part: getattr(theirs, part) for part in ("data", "network", "training", "sources")},
            evaluation={"seeds": theirs.evaluation.seeds},
            run={"compile": theirs.run.compile},
        )
    options = read(base, argv, description)
    out = from_leader(lambda: output_folder(options, study))
    if options.run.resume:
        stored = stored_options(type(base), out, study)
        options = read(stored, argv, description)
        check_same(stored, options, f"{out} was started with other values of", "choose another --out")
    if options.run.resume or finished is not None:
        check_typed(options, finished or out, known)
    if finished is not None:
        of_run(options, finished)
    check_device(options.run.device)
    name = options.run.logger
    if name in ("tensorboard", "wandb") and find_spec(name) is None:
        raise ImportError(f"--logger {name} needs the package {name}: pip install it")
    if options.run.engine == "ray":
        from lab.ray_cluster import check_ray

        check_ray(options.run.ray_address)
    options.check()
    place = options.data.dataset
    if place is not None:  # workers on other machines have other working directories
        options = with_parts(options, data={"dataset": Path(resolved_place(place))})
    return with_parts(options, run={"out": out})


def read[O](default: O, argv: Sequence[str], description: str | None) -> O:
    """A command line, on top of defaults."""
    written = io.StringIO()
    # A line that begins with a sign stays a line of its own.
    description = re.sub(r"^(?=python |torchrun )", "$ ", description or "", flags=re.M)
    try:
        with redirect_stderr(written):
            kind: Any = type(default)
            return tyro.cli(kind, default=default, args=argv, description=description)
    except SystemExit as stop:
        # What a dataclass refuses is reported like all that we refuse; what no option is, by tyro.
        refused: Any = stop.__context__
        if isinstance(getattr(refused, "arg", None), str):
            raise ValueError(str(refused.message)) from None
        sys.stderr.write(written.getvalue())
        raise


def output_folder(options: Options, study: str) -> Path:
    """The folder to write to; never one that holds a run, unless it is to be continued."""
    out, resume = options.run.out, options.run.resume
    if out is None:
        prefix = [] if study == "robomimic" else [study]
        name = "-".join([*prefix, options.name, options.run.preset])
        taken = sorted(
            int(folder.name[len(name) + 1 :] or 1)
            for folder in Path("runs").glob(f"{escape(name)}*")
            if folder.name == name or folder.name[len(name) + 1 :].isdigit()
        )
        number = (taken or [0])[-1] + (0 if resume and taken else 1)
        out = Path("runs") / (name if number == 1 else f"{name}-{number}")
    if (out / "options.json").exists() and not resume:
        raise ValueError(f"{out} holds a run: add --resume to continue it, or choose another --out")
    return out


def script(
    name: str, together: bool = False, hint: str = "--resume continues"
) -> Callable[[Callable[..., object]], Callable[..., int]]:
    """Make a function of a command line the `main` of a script, with errors as lines and an exit code."""
    return lambda work: (
        lambda argv=None: run_script(lambda: work(argv), name, errors=ERRORS, together=together, hint=hint)
    )


@contextmanager
def started(options: Options, study: str) -> Iterator[Path]:
    """The output folder, with the options in it, and without another process."""
    out = options.run.folder
    if rank():  # the first process is in it, for all
        yield out
        return
    check_writable(out)
    with exclusive(out):
        facts = facts_of_machine(workers=options.run.envs, device=options.run.device)
        record = {"study": study, **facts, "options": recorded(options)}
        text = json.dumps(record, indent=1) + "\n"
        write_atomic(out / "options.json", lambda path: path.write_text(text))
        print(f"Output folder: {out}", flush=True)
        try:
            yield out
        except Exception:
            if not options.run.resume and len(list(out.iterdir())) == 1:  # nothing was begun
                (out / "options.json").unlink()
            raise
