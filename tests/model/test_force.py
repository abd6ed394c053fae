import jax
import numpy as np
import pytest

import fitact
from fitact.model.force import plate_capacitance, summarize

NOMINAL = fitact.Contact(
    area=1e-4,
    insulator_thickness=1e-6,
    insulator_permittivity=3.9,
    skin_thickness=200e-6,
    skin_permittivity=5e3,
)


def test_force_of_the_paper_by_hand():
    """Eq. (22) at 15 V: 8.85e-12 * 1e-4 * 225 / (2 (1e-6/3.9 + 200e-6/5e3) * 201e-6)."""
    with jax.enable_x64(True):
        assert float(fitact.electrostatic_force(15.0, NOMINAL)) == pytest.approx(1.6711155e-3, rel=1e-6)


def test_permittivities_follow_the_capacitances():
    with jax.enable_x64(True):
        Ci = plate_capacitance(3.9, 1e-4, 1e-6)
        Csc = plate_capacitance(5e3, 1e-4, 200e-6)
        contact = fitact.Contact.from_capacitances(Ci, Csc, 1e-4, 1e-6, 200e-6)
        assert float(contact.insulator_permittivity) == pytest.approx(3.9, rel=1e-12)
        assert float(contact.skin_permittivity) == pytest.approx(5e3, rel=1e-12)
    assert pytest.approx(3.4515e-9) == Ci  # the text of the paper says 1.35 nF; its eq. (3) gives this


def test_friction():
    with jax.enable_x64(True):
        assert float(fitact.friction(0.2, 0.5, 0.5)) == pytest.approx(0.35)


def test_summary_weighs_by_time():
    with jax.enable_x64(True):
        mean, peak, rms = summarize(np.array([1.0, 3.0]), np.array([0.75, 0.25]))
    assert (float(mean), float(peak), float(rms)) == pytest.approx((1.5, 3.0, np.sqrt(3.0)))
