"""The command line of a script: its options, read and checked, and its output folder."""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from glob import escape
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import tyro

from lab.demonstrations.data_options import resolved_place
from lab.io.errors import ERRORS
from lab.io.machine import check_device, facts_of_machine
from lab.io.workers import at_most
from lab.options.options import Options, with_parts
from lab.options.presets import adapted
from lab.options.stored_options import check_same, check_typed, of_run, recorded, stored_options
from warmprior.io.distributed import from_leader, rank
from warmprior.io.files import check_writable, exclusive, write_atomic
from warmprior.io.option_help import registry
from warmprior.io.script import read_command_line, run_script


def parse[O: Options](
    presets: Mapping[str, O],
    argv: Sequence[str] | None,
    study: str,
    description: str | None,
    adapt: Callable[[O, O], O] = adapted,
) -> O:
    """Return the options of a command line, checked, with their output folder.

    They start from the options of --preset. With --resume they are those stored in the folder, and the
    command line may only repeat them.
    """
    argv = sys.argv[1:] if argv is None else list(map(str, argv))
    typed = read(next(iter(presets.values())), argv, description)
    if typed.preset not in presets:
        raise ValueError(f"--preset must be one of {', '.join(presets)}, got {typed.preset!r}")
    base = presets[typed.preset]
    importable = (*argv, *base.sources.prior, *base.data.task)
    base = adapt(base, typed)
    if not typed.data.generated:  # a preset's number is for generated demonstrations
        base = with_parts(base, data={"demonstrations": ()})
    finished: Path | None = getattr(typed, "policies", None)
    if finished is not None:
        finished_options = stored_options(Options, finished, None)
        base = with_parts(
            base,
            **{part: getattr(finished_options, part) for part in ("data", "network", "training", "sources")},
            evaluation={"seeds": finished_options.evaluation.seeds},
        )
    options = read(base, argv, description)
    out = from_leader(lambda: output_folder(options, study))
    if options.run.resume:
        stored = stored_options(type(base), out, study)
        options = read(stored, argv, description)
        check_same(stored, options, f"{out} was started with other values of", "choose another --out")
    if options.run.resume or finished is not None:
        check_typed(options, finished or out, importable)
    if finished is not None:
        of_run(options, finished)
    check_device(options.run.device)
    name = options.run.logger
    if name in ("tensorboard", "wandb") and find_spec(name) is None:
        raise ImportError(f"--logger {name} needs the package {name}: pip install it")
    if options.run.engine == "ray":
        from lab.io.ray_cluster import check_ray

        check_ray(options.run.ray_address)
    options.check()
    place = options.data.dataset
    if place is not None:  # workers may have another working directory
        options = with_parts(options, data={"dataset": Path(resolved_place(place))})
    return with_parts(options, run={"out": out})


def read[O](default: O, argv: Sequence[str], description: str | None) -> O:
    """Read a command line on top of defaults."""
    # tyro joins lines, unless they begin with a symbol.
    description = re.sub(r"^(?=python |torchrun )", "$ ", description or "", flags=re.M)
    kind: Any = type(default)
    # Errors of our dataclasses are reported in one line like all others.
    return read_command_line(
        partial(tyro.cli, kind, default=default, args=argv, description=description, registry=registry)
    )


def output_folder(options: Options, study: str) -> Path:
    """Return the output folder; raise ValueError if it holds a run that is not to be continued."""
    out, resume = options.run.out, options.run.resume
    if out is None:
        prefix = [] if study == "robomimic" else [study]
        name = "-".join([*prefix, options.name, options.preset])
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
    """Decorate a script's `main`: errors become one line, and it returns an exit code."""
    return lambda work: (
        lambda argv=None: run_script(lambda: work(argv), name, errors=ERRORS, together=together, hint=hint)
    )


@contextmanager
def started(options: Options, study: str) -> Iterator[Path]:
    """Yield the output folder, with the options in it, locked against other processes."""
    out = options.run.folder
    if rank():  # the first process has the lock
        yield out
        return
    check_writable(out)
    with exclusive(out), at_most(options.run.workers):  # demonstrations are generated by as many
        facts = facts_of_machine(workers=options.run.workers, device=options.run.device)
        record = {"study": study, **facts, "options": recorded(options)}
        text = json.dumps(record, indent=1) + "\n"
        write_atomic(out / "options.json", lambda path: path.write_text(text))
        print(f"Output folder: {out}", flush=True)
        try:
            yield out
        except Exception:
            if not options.run.resume and len(list(out.iterdir())) == 1:  # only options.json
                (out / "options.json").unlink()
            raise
