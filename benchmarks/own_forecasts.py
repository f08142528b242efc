"""Print how far a source's mean is from the demonstrated actions, by position, with the policy's own chunks.

python benchmarks/own_forecasts.py runs/policies/pusht-... --dataset lerobot:FOLDER --demonstrations 50
    --observations observation.state observation.environment_state

In training WP-Preview's mean is the demonstrated action itself. At decisions it is the policy's own forecast,
whose error this measures: on the demonstrations that the policy was trained on, and on the others of the
dataset. Errors are root mean squares in normalised units over steps with H earlier ones in their episode.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

from lab.options.command_line import script
from warmprior.io.script import read_command_line


@script("own_forecasts.py", hint="")
def main(argv: list[str] | None) -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("policies", nargs="+", metavar="FOLDER", help="folder of a saved policy")
    parser.add_argument("--dataset", required=True, help="place of the demonstrations")
    parser.add_argument("--observations", nargs="+", required=True, help="vectors that the policies see")
    parser.add_argument(
        "--demonstrations", type=int, required=True, help="number of the first ones, which they learnt from"
    )
    parser.add_argument("--windows", type=int, default=2000, help="number of steps (default: %(default)s)")
    parser.add_argument("--rows", type=Path, help="file to which the rows are added as JSON lines")
    args = read_command_line(lambda: parser.parse_args(argv))
    import torch
    from pandas import DataFrame

    from lab.measures.source_errors import error_by_position
    from warmprior.data import open_demonstrations
    from warmprior.diagnostics import SharedObservations
    from warmprior.keys import EPISODE
    from warmprior.saving import load_policy

    steps = open_demonstrations(args.dataset).steps(args.observations)
    numbers = steps[EPISODE].unique()
    parts = {"trained on": numbers[: args.demonstrations], "held out": numbers[args.demonstrations :]}
    rows: list[dict[str, Any]] = []
    for folder in args.policies:
        policy = load_policy(folder)
        if policy.normalizer is None:
            raise ValueError(f"{folder}: this policy has no normaliser, so its units are not known")
        for name, part in parts.items():
            if not len(part):
                continue
            data = policy.normalizer.normalize(steps[torch.isin(steps[EPISODE], part)])
            network: Any = policy.network
            prior, shape = policy.prior, {"observation_steps": network.observation_steps}
            shared = SharedObservations(data, prior.chunk_length, **shape)
            generator = torch.Generator().manual_seed(0)
            order = torch.randperm(len(shared), generator=generator)[: args.windows]
            windows = shared.subset(order.sort()[0]).deployed(policy, generator=generator)
            for nfe in (9, 1):
                mean, chunk = error_by_position(policy, windows, nfe=nfe)
                rows.append(
                    {"policy": Path(folder).parent.name, "prior": prior.name, "demonstrations": name}
                    | {"nfe": nfe, "mean_error": mean, "chunk_error": chunk}
                )
    if args.rows is not None:
        with args.rows.open("a") as file:
            file.writelines(json.dumps(row) + "\n" for row in rows)
    table = DataFrame(rows)
    for errors in ("mean_error", "chunk_error"):
        table[errors] = table[errors].map(lambda values: [round(value, 3) for value in values])
    print(table.to_string(index=False, max_colwidth=None))


if __name__ == "__main__":
    sys.exit(main())
