"""Print the model card of a policy with the results of a run, for python -m warmprior push --card README.md.

python benchmarks/card.py runs/can-ph-quick runs/policies/can-ph-.../policy_005000 > README.md
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from lab.options.command_line import script
from warmprior.io.script import read_command_line


@script("card.py", hint="")
def main(argv: list[str] | None) -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("run", type=Path, help="folder of the run whose results the card shows")
    parser.add_argument("folder", type=Path, help="folder of the saved policy")
    parser.add_argument(
        "--repository", default="user/name", help="hub repository that the card names (default: %(default)s)"
    )
    parser.add_argument("--license", help="licence of the policy in the hub's spelling, such as mit")
    args = read_command_line(lambda: parser.parse_args(argv))
    from lab.reporting.cards import measured
    from lab.reporting.report import policy_results
    from warmprior.saving import load_policy, model_card

    results = measured(policy_results(args.run, args.folder))
    actor = load_policy(args.folder)
    print(model_card(actor, **results, repository=args.repository, license=args.license))


if __name__ == "__main__":
    sys.exit(main())
