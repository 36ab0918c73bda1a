"""The next record that `diagnose` computes: do its rivals then differ by 10 nats?

    PYTHONPATH=tests/common python tests/separated.py --records 10 --again 2

A first record has one of two rivals, which `diagnose` cannot tell apart: others are drawn again. What its finding plans
is recorded as often as asked, with the rival that is true, after up to half an hour. `rival_records.py` draws and
scores. "Said" is the expected difference, the smaller of both directions. "Drawn" is the mean for the truth. "Right" of
the records have 10 nats and more for the truth, "wrong" ones for the rival.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from influences import Array
from rival_records import FIRST_S, Part, evidence

from selfcal.verbs.diagnose import diagnose

NATS = 10.0
PAIRS = {
    "temperature, turn_on": ("temperature", "turn_on"),
    "temperature, ramp": ("temperature", "ramp"),
    "temperature, supply": ("temperature", "supply"),
    "turn_on, ramp": ("turn_on", "ramp"),
    "supply, ramp": ("supply", "ramp"),
    "static, play": ("temperature (static)", "temperature (play)"),
    "static, rate": ("temperature (static)", "temperature (rate)"),
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--records", type=int, default=10, help="first records of each truth")
    parser.add_argument("--again", type=int, default=2, help="next records of each plan")
    parser.add_argument("--most", type=int, default=40, help="records drawn at most until so many are confused")
    parser.add_argument("--pairs", nargs="+", default=list(PAIRS))
    parser.add_argument("--verbose", action="store_true")
    given = parser.parse_args()
    start, all_right, all_wrong, of_all = time.process_time(), 0, 0, 0
    print("pair, truth: confused of drawn, no plan; median length, h; said; drawn; right, wrong of all")
    for pair in given.pairs:
        for side, true in enumerate(pair.split(", ")):
            rival = pair.split(", ")[1 - side]
            drawn, confused, none = 0, 0, 0
            nats, said, hours = [], [], []
            while confused < given.records and drawn < given.most:
                part = Part(pair, true, drawn)
                drawn += 1
                first = part.record(part.first(), part.since_on_s, FIRST_S)
                plan = planned(first, part, set(PAIRS[pair]))
                if plan is None:
                    continue
                confused += 1
                if plan["duration_s"] is None:
                    none += 1
                    continue
                known = [(first, part.since_on_s)]
                before = evidence(true, known) - evidence(rival, known)
                for _ in range(given.again):
                    begin_s = part.since_on_s + FIRST_S + part.random.uniform(0.0, 1800.0)
                    second = part.record(part.next(plan), begin_s, round(plan["duration_s"]))
                    both = [*known, (second, begin_s)]
                    nats.append(evidence(true, both) - evidence(rival, both) - before)
                    said.append(plan["expected_nats"])
                    if given.verbose:
                        print("   ", part.seed, plan, f"{before:.1f} {nats[-1]:.1f}")
                hours.append(plan["duration_s"] / 3600.0)
            right, wrong = sum(one >= NATS for one in nats), sum(one <= -NATS for one in nats)
            all_right, all_wrong, of_all = all_right + right, all_wrong + wrong, of_all + len(nats)
            told = f"{np.median(hours):.2f}; {np.mean(said):.0f}; {np.mean(nats):.0f}; " if nats else ""
            print(f"{pair}, {true}: {confused} of {drawn}, {none}; {told}{right}, {wrong} of {len(nats)}", flush=True)
    print(f"all: {all_right}, {all_wrong} of {of_all}; {time.process_time() - start:.0f} s of a processor")


def planned(readings: Mapping[str, Array], part: Part, pair: set[str]) -> dict[str, Any] | None:
    """The plan of the finding that names the pair; None where none does."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "log.npz"
        np.savez(path, **readings)
        found = diagnose(path, since_power_on_s=part.since_on_s)
    plans = [one["next_record"] for one in found["axes"]["gx"]["findings"]]
    return next((plan for plan in plans if plan is not None and set(plan["between"]) == pair), None)


if __name__ == "__main__":
    main()
