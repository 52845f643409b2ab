"""Terms of a calibration: their number, names, values and slopes."""

import numpy as np
import pytest

from balance_cli.calibration.terms import (
    Term,
    all_terms,
    largest_derivatives,
    linear_terms,
    term_derivatives,
    term_from_name,
    term_values,
)

LOADS = ("Fx", "Fy", "Fz", "Mx", "My", "Mz")


def test_there_are_96_terms_of_six_loads_in_the_usual_order():
    terms = all_terms(6)
    names = [term.name(LOADS) for term in terms]
    assert len(names) == len(set(names)) == 96
    assert terms[:6] == linear_terms(6)
    assert names[:7] == [*LOADS, "|Fx|"]
    assert names[12] == "Fx^2" and names[18] == "Fx|Fx|"
    assert names[24] == "Fx Fy" and names[39] == "|Fx Fy|" and names[54] == "Fx |Fy|" and names[69] == "|Fx| Fy"
    assert names[84] == "Fx^3" and names[90] == "|Fx^3|" and names[95] == "|Mz^3|"


@pytest.mark.parametrize("count", [1, 2, 3, 6])
def test_number_of_terms(count):
    assert len(set(all_terms(count))) == 2 * count * (count + 2)


def test_values_are_what_the_names_say():
    x = np.random.default_rng(0).uniform(-1.0, 1.0, (20, 6))
    values = term_values(all_terms(6), x)
    for i, term in enumerate(all_terms(6)):
        # `Fx^2 |My|` as Python: names are loads, bars are absolute values, what stands beside each other is multiplied.
        expected = np.ones(len(x))
        name = term.name(LOADS)
        if term.single_load:
            f = x[:, term.i]
            key = name.replace(LOADS[term.i], "F")
            expected = {
                "F": f,
                "|F|": abs(f),
                "F^2": f * f,
                "F|F|": f * abs(f),
                "F^3": f * f * f,
                "|F^3|": abs(f * f * f),
            }[key]
        else:
            f, g = x[:, term.i], x[:, term.j]
            key = name.replace(LOADS[term.i], "F").replace(LOADS[term.j], "G")
            expected = {"F G": f * g, "|F G|": abs(f * g), "F |G|": f * abs(g), "|F| G": abs(f) * g}[key]
        np.testing.assert_allclose(values[:, i], expected, rtol=1e-14, err_msg=name)


def test_slopes_are_those_of_finite_differences():
    terms, step = all_terms(6), 1e-6
    x = np.random.default_rng(1).uniform(0.05, 1.0, (30, 6)) * np.random.default_rng(2).choice([-1.0, 1.0], (30, 6))
    found = term_derivatives(terms, x)
    assert found.shape == (30, 96, 6)
    for j in range(6):
        more, less = x.copy(), x.copy()
        more[:, j] += step
        less[:, j] -= step
        np.testing.assert_allclose(
            found[:, :, j], (term_values(terms, more) - term_values(terms, less)) / (2 * step), atol=1e-9
        )


def test_slopes_at_a_fold_are_those_from_above():
    at = term_derivatives([term_from_name("|Fx|", LOADS), term_from_name("Fx|Fx|", LOADS)], np.zeros((1, 6)))
    assert at[0, 0, 0] == 1.0 and at[0, 1, 0] == 0.0


def test_no_slope_within_reach_is_steeper_than_the_steepest():
    terms, reach = all_terms(6), np.linspace(0.5, 1.3, 6)
    bound = largest_derivatives(terms, reach)
    x = np.random.default_rng(3).uniform(-1.0, 1.0, (500, 6)) * reach
    assert np.all(np.abs(term_derivatives(terms, x)) <= bound + 1e-14)
    np.testing.assert_allclose(np.abs(term_derivatives(terms, -reach[None]))[0], bound)


def test_a_term_is_found_by_its_name():
    assert all(term_from_name(term.name(LOADS), LOADS) == term for term in all_terms(6))
    with pytest.raises(KeyError):
        term_from_name("Fx^4", LOADS)


def test_what_a_term_is_made_of():
    cross = term_from_name("Fy |Mz|", LOADS)
    assert cross.loads == (1, 5) and not cross.single_load and cross.degree == 2 and not cross.linear
    assert term_from_name("|My^3|", LOADS).degree == 3 and term_from_name("My", LOADS).linear
    assert Term(4, 1, 4) == term_from_name("My", LOADS)
