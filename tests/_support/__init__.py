"""What many tests use: small scenes, numbers, and refusals."""

# ruff: noqa: F401
from tests._support.numbers import (
    double,
    eye,
    seeded,
    skip_unless_products_are_exact,
    uniform,
    zeros,
)
from tests._support.quick import slow_after
from tests._support.refusals import refused
from tests._support.scenes import (
    CAMERA,
    SIZE,
    answer_of,
    answer_to,
    bank_around,
    bank_of,
    bytes_bgr,
    check_agreement,
    check_near,
    degrees_off,
    errors,
    exact_registrar,
    first_scenes,
    found_in,
    learned_answer,
    learned_registrar,
    photograph_of,
    scene,
    seen_from,
    sequence,
    truck_answer,
    truck_bank,
    truck_registrar,
    two_trucks,
    unrefined,
    write_photo,
    write_video,
)
