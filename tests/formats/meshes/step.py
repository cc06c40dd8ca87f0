"""STEP files of a box and IGES files of a rectangle, as CAD programs write them, in several
units."""

from pathlib import Path

BOX = Path(__file__).with_name("box.step").read_text()
_MM = "( LENGTH_UNIT() NAMED_UNIT(*) SI_UNIT(.MILLI.,.METRE.) )"
_INCH = f"""( CONVERSION_BASED_UNIT('INCH',#1001) LENGTH_UNIT() NAMED_UNIT(#1002) );
#1000 = {_MM};
#1001 = LENGTH_MEASURE_WITH_UNIT(LENGTH_MEASURE(25.4),#1000);
#1002 = DIMENSIONAL_EXPONENTS(1.,0.,0.,0.,0.,0.,0.)"""
_UNITS = {"mm": _MM, "cm": _MM.replace("MILLI", "CENTI"), "in": _INCH}


def step_file(size, unit):
    """The text of a box with one corner at the origin."""
    text = BOX.replace("UNIT;", f"{_UNITS[unit]};")
    for name, side in zip(("WIDTH", "HEIGHT", "DEPTH"), size, strict=True):
        text = text.replace(name, str(float(side)))
    return text


def global_section(text):
    """The lines of an IGES file with its global parameters."""
    return [f"{text[k : k + 72]:<72}G{k // 72 + 1:7d}" for k in range(0, len(text), 72)]


def iges_file(size, flag, name):
    """The text of a rectangle at the origin: a ruled surface between two lines. ``flag`` is that of
    the unit."""
    parameters = [
        f"110,0.,0.,0.,{size[0]!r},0.,0.;",
        f"110,0.,{size[1]!r},0.,{size[0]!r},{size[1]!r},0.;",
        "118,1,3,0,0;",
    ]
    forms = [0, 0, 1]
    whole = "1H,,1H;,4Hpart,8Hpart.igs,3Hcad,3H1.0,32,38,6,308,15,4Hpart,1.,"
    whole += f"{flag},{len(name)}H{name},1,0.01,15H20260101.000000,1E-6,10.,1Ha,1Hb,11,0,15H20260101.000000;"  # noqa: E501
    head = global_section(whole)
    lines = [f"{'part':<72}S{1:7d}", *head]
    for k, text in enumerate(parameters):
        kind = int(text.partition(",")[0])
        first = (kind, k + 1, 0, 0, 0, 0, 0, 0, "00000000")
        second = (kind, 0, 0, 1, forms[k], "", "", "", 0)
        for number, row in ((2 * k + 1, first), (2 * k + 2, second)):
            lines.append("".join(f"{value:>8}" for value in row) + f"D{number:7d}")
    lines += [f"{text:<64}{2 * k + 1:8d}P{k + 1:7d}" for k, text in enumerate(parameters)]
    count = len(parameters)
    lines.append(f"S{1:7d}G{len(head):7d}D{2 * count:7d}P{count:7d}{'':40}T{1:7d}")
    return "\n".join(lines) + "\n"
