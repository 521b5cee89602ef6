"""No-go zones in an arm file, a table `[[no_go]]` each, in mm and the base frame.

[[no_go]]
name = "below the printing base"
half_space = [[0, 0, 1], [0, 0, -2]]        # outward normal, a place on the plane
[[no_go]]
name = "patient"
box = [[-300, 50, -100], [300, 150, 40]]    # or: cylinder = [[0, 0, 0], [0, 0, 100]] and radius = 80
"""

from __future__ import annotations

from estimation.errors import InputError
from estimation.se3 import Array
from hardware.process import checks
from planning.no_go import NoGo, box, cylinder, half_space

KINDS = ("half_space", "box", "cylinder")


def zones_from_tables(where: object, value: object) -> tuple[NoGo, ...]:
    """The zones of `[[no_go]]` tables; InputError names the key."""
    return tuple(_zone(where, table) for table in checks.tables(where, "no_go", value))


def no_go_lines(zones: tuple[NoGo, ...]) -> list[str]:
    """Tables that give the zones back: one of half-spaces each, with a cylinder where there is one."""
    lines: list[str] = []
    for zone in zones:
        lines += ["", "[[no_go]]", f'name = "{zone.name}"']
        if zone.radius < float("inf"):
            lines += [f"cylinder = {checks.toml_numbers(zone.axis)}", f"radius = {checks.toml_number(zone.radius)}"]
        elif len(zone.offsets) == 1:
            lines.append(f"half_space = {checks.toml_numbers(_plane(zone))}")
        else:
            lines.append(f"box = {checks.toml_numbers(_corners(zone))}")
    return lines


def _zone(where: object, table: checks.Table) -> NoGo:
    checks.check_keys(where, "no_go.", table, ("name",), (*KINDS, "radius"))
    name = checks.text(where, "no_go.name", table["name"])
    kinds = [kind for kind in KINDS if kind in table]
    if len(kinds) != 1 or ("radius" in table) != (kinds == ["cylinder"]):
        raise InputError(where, f"no_go {name!r}", kinds, "half_space, box, or cylinder with radius")
    first, second = checks.numbers(where, f"no_go.{kinds[0]}", table[kinds[0]], (2, 3), "mm")
    if kinds == ["cylinder"]:
        return cylinder(name, first, second, checks.number(where, "no_go.radius", table["radius"]))
    return half_space(name, first, second) if kinds == ["half_space"] else box(name, first, second)


def _plane(zone: NoGo) -> Array:
    plane: Array = zone.normals.repeat(2, axis=0) * [[1.0], [zone.offsets[0]]]
    return plane


def _corners(zone: NoGo) -> Array:
    corners: Array = (zone.offsets.reshape(2, 3) * [[1.0], [-1.0]])[::-1]
    return corners
