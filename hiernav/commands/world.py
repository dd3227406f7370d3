"""`hiernav world`: a world as a picture or as JSON."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

from hiernav.commands.arguments import Commands


def add(commands: Commands) -> None:
    """Add it to the command line."""
    parser = commands.add_parser(
        "world", help="draw a world", description="Sample a world from a seed and draw it, or print it as JSON."
    )
    parser.add_argument(
        "--kind", "--world", default="pillar(2,2,10)", metavar="WORLD", help="which world (pillar(2,2,10))"
    )
    parser.add_argument("--seed", type=int, default=0, help="decides the layout (0)")
    parser.add_argument("--radius", type=float, default=0.1, help="of the robot it must be solvable for [m] (0.1)")
    parser.add_argument("--png", metavar="FILE", help="picture to write")
    parser.add_argument("--json", action="store_true", help="print the layout as JSON")
    parser.set_defaults(run=run, parser=parser)


def run(arguments: argparse.Namespace) -> int:
    from hiernav.sim.layout import parse_world
    from hiernav.sim.worlds import sample_layout

    if arguments.png and Path(arguments.png).suffix != ".png":
        raise ValueError(f"--png {arguments.png} must end in .png")
    layout = sample_layout(parse_world(arguments.kind), arguments.seed, arguments.radius)
    if arguments.json or not arguments.png:
        shown = {
            "world": str(layout.spec),
            "seed": layout.seed,
            "start": layout.start.tolist(),
            "goal": layout.goal.tolist(),
            "pillars": layout.pillars.tolist(),
            "gremlins": layout.gremlins.tolist(),
            "walls": layout.walls.tolist(),
            "max_steps": layout.spec.max_steps,
            "redraws": layout.redraws,
        }
        print(json.dumps(shown, indent=2))
    if arguments.png:
        from hiernav.draw import draw_layout

        draw_layout(layout, Path(arguments.png))
        print(f"wrote {arguments.png}", file=sys.stderr if arguments.json else sys.stdout)
    return 0
