"""Plan a scanned wound and write the path: python docs/examples/plan_wound.py SCAN.ply PATH.csv"""

from __future__ import annotations

from hardware.cli.parser import run_script
from hardware.files.mesh_file import read_raw_mesh
from hardware.files.path_file import write_path
from planning.fill.bead import Pattern
from planning.layers.plan import PlanOrder, figures_of, make_plan, total_of
from planning.layers.repair import repair_mesh
from planning.layers.slicing import Tissue
from planning.layers.wound import find_wound

BEAD = 0.8  # mm
TISSUES = (  # from the wound's bed upwards; None: as thick as what the others leave
    Tissue("hypodermis", None, "fat"),
    Tissue("dermis", 1.5, "collagen"),
    Tissue("epidermis", 0.5, "keratinocytes"),
)


def main(scan: str, out: str) -> None:
    """Mend the scan, find the wound in it, fill it with layers of spiral beads, and say what came of it."""
    mesh = read_raw_mesh(scan)
    mended, _ = repair_mesh(mesh.vertices, mesh.triangles, scan)
    plan = make_plan(find_wound(mended, 0.6 * BEAD, scan), PlanOrder(TISSUES, Pattern("spiral", BEAD)))
    write_path(out, plan.path)
    total = total_of(figures_of(plan))
    print(f"{len(plan.layers)} layers, {len(plan.path)} checkpoints, {100 * total.covered:.1f} % covered")


if __name__ == "__main__":
    run_script(main, __doc__)
