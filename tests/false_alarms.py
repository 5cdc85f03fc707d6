r"""The chance that the suite raises an alarm although nothing is wrong, and the comparisons of noise that it is made of.

Every comparison whose outcome depends on random numbers goes through a function of this file. Each notes, before it
compares, the chance that it raises although the code is right. By the union bound the chance that one run of the suite
raises any false alarm is at most the sum of these, whatever samples the tests share. The sum is printed at the end of a run,
and a run whose sum passes ``AIM`` ends red.

The laws. Student's t at the effective degrees of freedom (Welch, Satterthwaite) holds for normal batch means. A batch is a
mean of many samples, so it is nearly normal where their variance exists; where it does not, medians are compared. How near
shows in the p-values: of k comparisons that hold, the smallest p-value is below x with chance 1 - (1 - x)^k at most. It is
printed beside the sum, so that a law that does not hold is seen long before it raises at ``ALPHA``.

A test that compares so is marked ``statistical``: ``pytest --seeds 20 -m statistical`` runs each with 20 rounds of seeds,
which :func:`fresh` moves. A test that compares without the mark is red, and so is one with it that compares nothing.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterator

import numpy as np
import pytest
from scipy import stats

from mivol.validate import statistics
from mivol.validate.statistics import Estimate, Moments, Significance, effective_dof

ALPHA = 4e-9
"""Chance of a false alarm of one comparison, of all its pixels together. Some 1200 of them, slow ones included, add up to half
of AIM."""

AIM = 1e-5
"""What the chances of all comparisons may add up to, slow ones included."""

KEY = "false alarm"
ROUND = 1_000_003
"""By how much a round of seeds lies above the one before; more than any test counts, and a prime."""


# -- What is compared ----------------------------------------------------------------------------------------------------


def over_pixels(image: Moments) -> Estimate:
    """The mean of each channel (C,) over the independent pixels of an image (H, W, C)."""
    var, pixels = image.variance_of_mean, np.prod(image.mean.shape[:2])
    return Estimate(
        image.mean.mean(axis=(0, 1)), var.sum(axis=(0, 1)) / pixels**2, effective_dof(var, image.n - 1, axis=(0, 1))
    )


def difference(a: Estimate | Moments, b: Estimate | Moments | np.ndarray | float) -> Estimate:
    """a - b of independent estimates."""
    a, b = Estimate.from_result(a), Estimate.from_result(b)
    var, dof = np.broadcast_arrays(a.var, b.var), np.broadcast_arrays(a.dof, b.dof)
    dof = np.stack([np.broadcast_to(d, var[0].shape) for d in dof])
    return Estimate(a.mean - b.mean, var[0] + var[1], effective_dof(np.stack(var), dof, axis=0))


def assert_same_mean(
    a: Estimate | Moments,
    b: Estimate | Moments | np.ndarray | float = 0.0,
    *,
    tile: int = 1,
    rounding: float = 0.0,
    what: str = "the means",
) -> None:
    """Two estimates agree, or one agrees with an exact answer: Student's t, all entries for one ``ALPHA``.

    Args:
        tile: images (H, W, C) are averaged over tiles of so many pixels first.
        rounding: what float32 arithmetic may cause, as one standard deviation.
    """
    a, b = Estimate.from_result(a), Estimate.from_result(b)
    b = b._replace(mean=np.broadcast_to(b.mean, np.shape(a.mean)))
    how = {"tile": tile, "rounding": rounding}
    note(ALPHA, what, statistics.p_value(a, b, **how))
    statistics.assert_same_mean(a, b, level=Significance(ALPHA), what=what, **how)


def assert_same_bounded_mean(
    mean: np.ndarray, n: int, truth: np.ndarray, *, bounds: tuple[float, float] = (0.0, 1.0), what: str = "the means"
) -> None:
    """Means of n samples between two bounds agree with exact answers, by Hoeffding's bound: no normality is assumed."""
    p = statistics.bounded_p_value(mean, n, truth, bounds)
    note(ALPHA, what, min(1.0, float(np.min(p)) * np.size(p)))
    statistics.assert_same_bounded_mean(mean, n, truth, bounds=bounds, level=Significance(ALPHA), what=what)


def assert_rate(hits: int, runs: int, rate: float, at_least: float | None = None) -> None:
    """A count of independent events agrees with the rate that is claimed, by the exact binomial law.

    Args:
        at_least: where the claim is an upper bound, what the rate is at least.
    """
    lower = rate if at_least is None else at_least
    p = min(1.0, 2 * min(stats.binom.cdf(hits, runs, lower), stats.binom.sf(hits - 1, runs, rate)))
    note(ALPHA, "rate", p)
    assert p > ALPHA, f"{hits} of {runs} events of a rate of {rate}: p = {p:.2g}"


def assert_same_median(values: np.ndarray, truth: np.ndarray | float, what: str = "the medians") -> None:
    """Medians of independent values (n, ...) agree with exact ones: the sign test, for laws without a variance.

    The count of values below the median of their law is binomial with rate 1/2, whatever the law is.
    """
    below, n = np.sum(np.asarray(values) < truth, axis=0), len(values)
    tails = np.minimum(stats.binom.cdf(below, n, 0.5), stats.binom.sf(below - 1, n, 0.5))
    p = float(min(1.0, 2 * np.min(tails) * np.size(tails)))
    note(ALPHA, what, p)
    assert p > ALPHA, f"{what}: {below} of {n} values lie below {truth}, p = {p:.2g}"


def assert_precise(
    given: Estimate | Moments, limit: np.ndarray | float, *, of: Callable = np.max, what: str = "the means"
) -> None:
    r"""Standard errors are at most ``limit``, else a comparison of the means sees nothing.

    :math:`d s^2/\sigma^2` of an estimate s of a standard error is chi-square with its d degrees of freedom. It raises where
    s^2 is above limit^2 by more than that allows at ``ALPHA`` shared among the entries, so that true errors up to the limit
    raise no alarm. What passes is below 2.4 times the limit at 15 degrees of freedom, and below 1.15 times at 1000.

    Args:
        of: np.max asks it of each entry, np.median of half of them (which fails only where one of that half fails).
    """
    given = Estimate.from_result(given)
    var, allowed, dof = np.broadcast_arrays(given.var, np.square(limit), given.dof)
    known = np.isinf(dof)
    with np.errstate(divide="ignore", invalid="ignore"):
        share = np.where(var > 0, var / allowed, 0.0)  # what has no noise is precise beside 0, too
        tails = np.where(known, share <= 1, stats.chi2.sf(share * np.where(known, 0.0, dof), np.where(known, 1.0, dof)))
    p = float(min(1.0, tails.size * -of(-tails)))
    note(ALPHA, f"precision of {what}", p)
    assert p > ALPHA, f"{what}: standard errors of up to {of(np.sqrt(share)):.2g} times the limit, p = {p:.2g}"


def assert_same_spread(
    a: Estimate | Moments,
    b: Estimate | Moments,
    *,
    expected: float = 1.0,
    low: float = 0.0,
    high: float,
    dof: tuple[float, float] | None = None,
    what: str,
) -> None:
    r"""The variance of a lies between ``low`` and ``high`` times that of b, where ``expected`` times is derived.

    Both are sums over independent pixels (give one channel), of effective degrees of freedom d_a and d_b, or of those given.
    Their ratio over ``expected`` follows F(d_a, d_b), which gives the chance of either side.
    """
    a, b = Estimate.from_result(a), Estimate.from_result(b)
    dof = dof or tuple(float(effective_dof(x.var, x.dof)) for x in (a, b))
    ratio = float(np.mean(a.var) / np.mean(b.var))
    law = stats.f(*dof)
    note(law.sf(high / expected) + law.cdf(low / expected), what, 2 * min(law.cdf(ratio / expected), law.sf(ratio / expected)))
    assert low < ratio < high, f"{what}: variances in the ratio {ratio:.3g}, expected is {expected:.3g}"


def assert_same_variance(
    values: np.ndarray, truth: np.ndarray | float, *, mean: float | None = None, excess: float = 0.0, what: str
) -> None:
    r"""The variance of values (n, ...) along the first axis is ``truth``.

    :math:`d s^2/\sigma^2` of normal values is chi-square with d = n - 1 degrees of freedom, or n where their ``mean`` is known.
    For values of another law its variance is (1 + excess/2) times as large, with their excess kurtosis; then d is smaller by
    that factor.
    """
    values = np.asarray(values, dtype=np.float64)
    d = len(values) - (mean is None)
    share = ((values - (values.mean(axis=0) if mean is None else mean)) ** 2).sum(axis=0) / d / truth
    law = stats.chi2(d / (1 + excess / 2))
    tails = np.minimum(law.cdf(share * law.mean()), law.sf(share * law.mean()))
    p = float(min(1.0, 2 * tails.size * np.min(tails)))
    note(ALPHA, what, p)
    assert p > ALPHA, f"{what}: {np.min(share):.4g} to {np.max(share):.4g} of the variance said, p = {p:.2g}"


def assert_apart(a: Estimate | Moments, b: Estimate | Moments | float, *, expected: float, what: str) -> None:
    """Two means differ, by more than half of the difference that is ``expected``.

    Noise hides that difference where it makes more than half of it: the tail of Student's t beyond half the difference, in
    standard errors as they are estimated.
    """
    found, var, dof = (float(np.squeeze(x)) for x in difference(a, b))
    found, half = abs(found), abs(expected) / 2 / np.sqrt(var)
    note(float(stats.norm.sf(half) if np.isinf(dof) else stats.t.sf(half, dof)), what)
    assert found > abs(expected) / 2, f"{what}: they differ by {found:.3g}, where {expected:.3g} is expected"


def assert_within(error: np.ndarray | float, bound: np.ndarray | float, *, chance: float, what: str) -> None:
    """Errors are at most their bounds, which all of them keep but for a chance that the test derives."""
    note(chance, what)
    share = np.asarray(np.abs(error), dtype=np.float64) / bound
    assert np.all(np.abs(error) <= bound), f"{what}: an error of {share.max():.3g} of its bound (chance {chance:.2g})"


# -- Whose chance it is --------------------------------------------------------------------------------------------------


_running: list[pytest.Item] = []


def note(chance: float, what: str, p: float | None = None) -> None:
    """A comparison that is about to be made: its chance of a false alarm, and the p-value of what it found."""
    assert _running, "comparisons are counted for the test that runs them; none runs"
    item = _running[-1]
    if item.get_closest_marker("statistical") is None:
        pytest.fail(f"{what} are compared as noise: mark the test with @pytest.mark.statistical", pytrace=False)
    item.user_properties.append((KEY, [round_of(item), float(chance), None if p is None else float(p)]))


def round_of(item: pytest.Item) -> int:
    """Which round of seeds a test runs with."""
    return item.callspec.params.get("seed", 0) if hasattr(item, "callspec") else 0


def fresh(seed: int) -> int:
    """The seed of this round of seeds; of the first round, the seed itself."""
    return seed + (ROUND * round_of(_running[-1]) if _running else 0)


class Count:
    """The plugin of pytest: which test runs, what it noted, and what that adds up to."""

    def __init__(self) -> None:
        self.chances: dict[int, float] = defaultdict(float)
        self.p_values: list[tuple[float, str]] = []
        self.largest = (0.0, "")
        self.tests: set[str] = set()
        self.comparisons = 0

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_protocol(self, item: pytest.Item) -> Iterator[None]:
        """Fixtures draw numbers too: the test runs from its setup on."""
        _running.append(item)
        try:
            return (yield)
        finally:
            _running.pop()

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_call(self, item: pytest.Item) -> Iterator[None]:
        """A test that claims to compare noise does so."""
        result = yield
        if item.get_closest_marker("statistical") and not any(key == KEY for key, _ in item.user_properties):
            pytest.fail("is marked statistical and compares nothing by tests/false_alarms.py", pytrace=False)
        return result

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Under pytest-xdist the reports of all workers arrive here."""
        if report.when != "call":
            return
        for key, value in report.user_properties:
            if key == KEY:
                number, chance, p = value
                self.comparisons += 1
                self.chances[number] += chance
                self.tests.add(report.nodeid)
                self.largest = max(self.largest, (chance, report.nodeid))
                self.p_values += [] if p is None else [(p, report.nodeid)]

    @property
    def most(self) -> float:
        """The sum of chances of the round of seeds where it is largest."""
        return max(self.chances.values(), default=0.0)

    def pytest_sessionfinish(self, session: pytest.Session) -> None:
        """A suite that raises false alarms too often is red."""
        if self.most > AIM and session.exitstatus == 0:
            session.exitstatus = pytest.ExitCode.TESTS_FAILED

    def pytest_terminal_summary(self, terminalreporter: pytest.TerminalReporter) -> None:
        """One line, or two."""
        if not self.comparisons:
            return
        rounds = f" in each of {len(self.chances)} rounds of seeds" if len(self.chances) > 1 else ""
        line = f"{self.comparisons} comparisons of noise in {len(self.tests)} tests: a false alarm with a chance of at most "
        line += f"{self.most:.2g}{rounds} (aim: below {AIM:g})"
        terminalreporter.write_line(line, red=self.most > AIM)
        if self.most > AIM:
            terminalreporter.write_line("the largest chance is {:.2g}, of {}".format(*self.largest), red=True)
        if self.p_values:
            (p, test), k = min(self.p_values), len(self.p_values)
            chance = -np.expm1(k * np.log1p(-min(p, 1 - 1e-16)))
            terminalreporter.write_line(f"smallest of {k} p-values: {p:.2g} (as small with a chance of {chance:.2g}), {test}")
