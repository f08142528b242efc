"""The card of a policy with a run's results, for python -m warmprior push --card README.md.

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
    parser.add_argument("run", type=Path, help="whose results the card tells")
    parser.add_argument("folder", type=Path, help="of the policy")
    parser.add_argument("--repository", default="user/name", help="where it will lie")
    parser.add_argument("--licence", help="of the policy, as the hub calls it, such as mit")
    a = parser.parse_args(argv)
    results = policy_results(a.run, a.folder)
    print(model_card(load_policy(a.folder), results, repository=a.repository, licence=a.licence))


if __name__ == "__main__":
    sys.exit(main())
