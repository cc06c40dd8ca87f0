"""STEP files of a box and IGES files of a rectangle, as CAD programs write them, in several
units."""

_UNITS = {
    "mm": "( LENGTH_UNIT() NAMED_UNIT(*) SI_UNIT(.MILLI.,.METRE.) )",
    "cm": "( LENGTH_UNIT() NAMED_UNIT(*) SI_UNIT(.CENTI.,.METRE.) )",
    "m": "( LENGTH_UNIT() NAMED_UNIT(*) SI_UNIT($,.METRE.) )",
}
_CONVERTED = {"in": ("INCH", 25.4), "ft": ("FOOT", 304.8)}


class _Writer:
    def __init__(self):
        self.lines: list[str] = []

    def add(self, text):
        self.lines.append(f"#{len(self.lines) + 1} = {text};")
        return f"#{len(self.lines)}"


def step_file(size, unit):
    """The text of a box with one corner at the origin."""
    w = _Writer()
    corners = [(x, y, z) for x in (0.0, size[0]) for y in (0.0, size[1]) for z in (0.0, size[2])]
    points = [w.add(f"CARTESIAN_POINT('',({x!r},{y!r},{z!r}))") for x, y, z in corners]
    vertices = [w.add(f"VERTEX_POINT('',{point})") for point in points]
    edges = {}

    def direction(values):
        length = sum(v * v for v in values) ** 0.5
        x, y, z = (float(v / length) for v in values)
        return w.add(f"DIRECTION('',({x!r},{y!r},{z!r}))")

    def edge(a, b):
        first = min(a, b)
        second = max(a, b)
        if (first, second) not in edges:
            along = [q - p for p, q in zip(corners[first], corners[second], strict=True)]
            vector = w.add(f"VECTOR('',{direction(along)},1.)")
            line = w.add(f"LINE('',{points[first]},{vector})")
            curve = w.add(f"EDGE_CURVE('',{vertices[first]},{vertices[second]},{line},.T.)")
            edges[first, second] = curve
        forwards = ".T." if a < b else ".F."
        return w.add(f"ORIENTED_EDGE('',*,*,{edges[first, second]},{forwards})")

    sides = [
        ((0, 1, 3, 2), (-1, 0, 0)),
        ((4, 6, 7, 5), (1, 0, 0)),
        ((0, 4, 5, 1), (0, -1, 0)),
        ((2, 3, 7, 6), (0, 1, 0)),
        ((0, 2, 6, 4), (0, 0, -1)),
        ((1, 5, 7, 3), (0, 0, 1)),
    ]
    faces = []
    for ring, normal in sides:
        around = ",".join(edge(a, b) for a, b in zip(ring, ring[1:] + ring[:1], strict=True))
        loop = w.add(f"EDGE_LOOP('',({around}))")
        bound = w.add(f"FACE_OUTER_BOUND('',{loop},.T.)")
        along = [q - p for p, q in zip(corners[ring[0]], corners[ring[1]], strict=True)]
        place = w.add(
            f"AXIS2_PLACEMENT_3D('',{points[ring[0]]},{direction(normal)},{direction(along)})"
        )
        plane = w.add(f"PLANE('',{place})")
        faces.append(w.add(f"ADVANCED_FACE('',({bound}),{plane},.T.)"))
    shell = w.add(f"CLOSED_SHELL('',({','.join(faces)}))")
    solid = w.add(f"MANIFOLD_SOLID_BREP('',{shell})")
    if unit in _UNITS:
        length = w.add(_UNITS[unit])
    else:
        name, millimetres = _CONVERTED[unit]
        measure = w.add(
            f"LENGTH_MEASURE_WITH_UNIT(LENGTH_MEASURE({millimetres}),{w.add(_UNITS['mm'])})"
        )
        exponents = w.add("DIMENSIONAL_EXPONENTS(1.,0.,0.,0.,0.,0.,0.)")
        length = w.add(
            f"( CONVERSION_BASED_UNIT('{name}',{measure}) LENGTH_UNIT() NAMED_UNIT({exponents}) )"
        )
    angle = w.add("( NAMED_UNIT(*) PLANE_ANGLE_UNIT() SI_UNIT($,.RADIAN.) )")
    solid_angle = w.add("( NAMED_UNIT(*) SI_UNIT($,.STERADIAN.) SOLID_ANGLE_UNIT() )")
    precision = w.add(
        f"UNCERTAINTY_MEASURE_WITH_UNIT(LENGTH_MEASURE(1.E-07),{length},'distance_accuracy_value','')"
    )
    context = w.add(
        "( GEOMETRIC_REPRESENTATION_CONTEXT(3) "
        f"GLOBAL_UNCERTAINTY_ASSIGNED_CONTEXT(({precision})) "
        f"GLOBAL_UNIT_ASSIGNED_CONTEXT(({length},{angle},{solid_angle})) "
        f"REPRESENTATION_CONTEXT('','') )"
    )
    shape = w.add(f"ADVANCED_BREP_SHAPE_REPRESENTATION('',({solid}),{context})")
    application = w.add("APPLICATION_CONTEXT('automotive design')")
    w.add(
        f"APPLICATION_PROTOCOL_DEFINITION('international "
        f"standard','automotive_design',2000,{application})"
    )
    of_product = w.add(f"PRODUCT_CONTEXT('',{application},'mechanical')")
    product = w.add(f"PRODUCT('part','part','',({of_product}))")
    formation = w.add(f"PRODUCT_DEFINITION_FORMATION('','',{product})")
    stage = w.add(f"PRODUCT_DEFINITION_CONTEXT('part definition',{application},'design')")
    definition = w.add(f"PRODUCT_DEFINITION('design','',{formation},{stage})")
    of_shape = w.add(f"PRODUCT_DEFINITION_SHAPE('','',{definition})")
    w.add(f"SHAPE_DEFINITION_REPRESENTATION({of_shape},{shape})")
    head = "ISO-10303-21;\nHEADER;\nFILE_DESCRIPTION(('a box'),'2;1');\n"
    head += "FILE_NAME('part','2026-01-01T00:00:00',(''),(''),'','','');\n"
    head += "FILE_SCHEMA(('AUTOMOTIVE_DESIGN { 1 0 10303 214 1 1 1 1 }'));\nENDSEC;\nDATA;\n"
    return head + "\n".join(w.lines) + "\nENDSEC;\nEND-ISO-10303-21;\n"


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
    head = [whole[k : k + 72] for k in range(0, len(whole), 72)]
    lines = [f"{'part':<72}S{1:7d}", *(f"{text:<72}G{k + 1:7d}" for k, text in enumerate(head))]
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
