"""Ablations of the radiance-predicting network: `python -m benchmarks.ablations` trains all variants side by side and judges them."""

from __future__ import annotations

import argparse
import json
import logging
import subprocess
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from deepclouds_training.network import Network, NetworkConfig

from benchmarks.ablation_page import LINK, PICTURE, body, draw
from benchmarks.ablation_results import figures, held_out, multiply_adds, predictions, query_seconds, weights
from benchmarks.ablation_training import BATCH, Learner, Plan, Race
from benchmarks.ablation_variants import BASE, SETS
from benchmarks.page import write_results
from deepclouds.errors import InputError
from deepclouds.replacing import replacing

log = logging.getLogger(__name__)
PAGE = Path("docs/ablations.md")
HELD_OUT = (Path("work/valid_converged"), Path("work/valid_halves"))
RESULTS = "results.json"
TITLES = {"separate": "One departure at a time", "together": "What won, together"}
LARGE = NetworkConfig(width=192, compression="root")


def main(argv: Sequence[str] | None = None) -> int:
    """Train, judge, write; a run that was interrupted goes on."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.ablations", description=__doc__)
    parser.add_argument("--data", type=Path, default=Path("work/labels"))
    parser.add_argument("--minutes", type=float, default=35.0, help="of training, all networks together")
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--set", choices=tuple(SETS), default="separate", help="departures one by one, or those that won together")
    parser.add_argument("--shards", type=int, default=Plan.shards, help="shards of a pool")
    parser.add_argument("-o", "--output", type=Path, default=Path("work/ablations"), help="a folder for each set is made in it")
    parser.add_argument("--docs", action="store_true", help=f"write {RESULTS} of the output folder into {PAGE}, without training")
    options = parser.parse_args(argv)
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s", datefmt="%H:%M:%S")
    if options.docs:
        paths = {name: options.output / name / RESULTS for name in SETS}
        found = {name: json.loads(path.read_text()) for name, path in paths.items() if path.exists()}
        if not found:
            raise InputError(f"{options.output}: no results yet; run without --docs first")
        draw(list(found.values()), PAGE.parent / PICTURE)
        write_results(PAGE, "ablations", "\n\n".join([*(f"## {TITLES[name]}\n\n{body(r)}" for name, r in found.items()), LINK]))
        return 0
    plan = Plan(options.data, options.minutes, shards=options.shards)
    learners = [Learner(v, seed, plan) for v in SETS[options.set] for seed in range(options.seeds)]
    folder = options.output / options.set
    race = Race(plan, learners, folder)
    race.run()
    results = _judged(race)
    path = folder / RESULTS
    with replacing(path, ".json") as temporary:
        temporary.write_text(json.dumps(results, indent=1))
    print(body(results))
    return 0


def _judged(race: Race) -> dict[str, Any]:
    assert race.readings is not None
    torch.set_num_threads(race.plan.threads)
    averaged = {learner.key: learner.average.averaged(learner.network).eval() for learner in race.learners}
    converged, halves = (predictions(averaged, race.readings, held_out(folder)) for folder in HELD_OUT)
    log.info("measuring the cost of a query")
    first = {learner.variant.name: averaged[learner.key] for learner in race.learners if learner.seed == 0}
    seconds = query_seconds({**first, "large": Network(LARGE)})
    rows = []
    for variant in dict.fromkeys(learner.variant for learner in race.learners):
        mine = [learner for learner in race.learners if learner.variant == variant]
        network = first[variant.name]
        rows.append(
            {
                "name": variant.name,
                "group": variant.group,
                "what": variant.what,
                "weights": weights(network),
                "multiply_adds": multiply_adds(network),
                "seconds": seconds[variant.name][0],
                "batch": seconds[variant.name][1],
                "training_seconds": sum(learner.seconds for learner in mine) / len(mine),
                "seeds": [figures(converged[learner.key], halves[learner.key]) for learner in mine],
            }
        )
    return {
        "commit": subprocess.run(["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True, check=True).stdout.strip(),
        "samples": race.step * BATCH,
        "minutes": race.elapsed / 60,
        "base": BASE,
        "large": {"weights": weights(Network(LARGE)), "multiply_adds": multiply_adds(Network(LARGE)), "seconds": seconds["large"][0]},
        "rows": rows,
    }


if __name__ == "__main__":
    raise SystemExit(main())
