"""Traps of the libraries below fpirhc: what they do wrong without saying so, and that a guard here catches it."""

import pickle
from dataclasses import replace

import casadi as ca
import numpy as np

import fpirhc as fp


def test_ipopt_prints_nothing(capfd):
    """Its banner would spoil what --json prints."""
    short = replace(fp.load_problem("two_mass").problem, duration=0.01, measure_from=0.0)
    fp.simulate(short, fp.RecedingHorizon(fp.Ipopt(tolerance=1e-3)), seed=0, compiled=False)
    assert capfd.readouterr().out == ""


def test_a_power_has_no_finite_derivatives_at_its_kink():
    """CasADi's derivatives of sign(e) |e|^1.5 at zero are NaN or infinite; signed_power is rounded off and has finite ones."""
    e = ca.SX.sym("e")

    def derivatives(value):
        hessian, gradient = ca.hessian(value, e)
        return [float(v) for v in ca.Function("derivatives", [e], [gradient, hessian])(0.0)]

    assert not np.isfinite(derivatives(ca.sign(e) * ca.fabs(e) ** 1.5)).all()
    slope, curvature = derivatives(fp.signed_power(e, 1.5))
    assert 0 < slope < 1e-2 > abs(curvature)


def test_the_package_is_pickled_by_its_name():
    """lazy_loader gives it a class of module that pickles by value cannot take; functions of notebooks hold the package itself."""
    content = pickle.dumps(fp)
    assert len(content) < 100
    assert pickle.loads(content) is fp
