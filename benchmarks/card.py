"""Print the model card of a policy with the results of a run, for python -m warmprior push --card README.md.

python benchmarks/card.py runs/square-ph-quick runs/policies/square-ph-.../policy_010000 > README.md
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from lab.command_line import script
from lab.report import policy_results
from warmprior.training import load_policy, model_card


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
    parser.add_argument("--licence", help="licence of the policy in the hub's spelling, such as mit")
    args = parser.parse_args(argv)
    results = policy_results(args.run, args.folder)
    card = model_card(load_policy(args.folder), results, repository=args.repository, licence=args.licence)
    print(card)


if __name__ == "__main__":
    sys.exit(main())
