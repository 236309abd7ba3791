"""What an installed wheel must do without any extra: build a set, keep it, locate a scan."""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

import anchorscan


def main() -> None:
    """Run the smoke test."""
    assert "site-packages" in anchorscan.__file__, "this is not the installed package"
    world = anchorscan.random_building(3)
    records = list(anchorscan.drive(world, seed=3))[:120]
    with tempfile.TemporaryDirectory() as folder:
        path, log = Path(folder) / "a.apr", Path(folder) / "log.npz"
        with anchorscan.ReferenceSet.build(records, path=path) as places:
            best = places.locate(records[7].scan)[0]
        assert best.pose.distance(records[7].pose) < 0.5
        scan = records[0].scan
        np.savez(
            log,
            ranges=np.array([record.scan.ranges for record in records[:5]]),
            angle_min=scan.angle_min,
            angle_increment=scan.angle_increment,
        )
        words = [str(Path(sys.executable).with_name("anchorscan")), "locate", str(path), str(log)]
        done = subprocess.run(words, capture_output=True, text=True, check=True)
        lines = [json.loads(line) for line in done.stdout.splitlines()]
        assert [line["scan"] for line in lines] == [0, 1, 2, 3, 4]
    print(f"anchorscan {anchorscan.__version__} works")


if __name__ == "__main__":
    main()
