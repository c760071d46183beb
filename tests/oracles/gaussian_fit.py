"""Fits the polynomials of shaders/shared/gaussian.wgsl: smallest largest relative error, by exchange (Remez).

    pip install mpmath
    python tests/oracles/gaussian_fit.py

erfcx(x) = exp(x^2) erfc(x) for x >= 0 is p(s) / (1 + 2 x) with s = (x - 2.5) / (x + 2.5), which maps all x to [-1, 1);
erf(x) for x <= 1/2 is x p(x^2). Prints coefficients from the highest power down, and the largest relative error.
"""

from mpmath import cos, erf, erfc, exp, lu_solve, matrix, mp, mpf, nstr, pi, sqrt

mp.dps = 30
MIDDLE = mpf(5) / 2


def erfcx(x):
    if x > 1e4:
        return (1 - 1 / (2 * x**2) + 3 / (4 * x**4)) / (x * sqrt(pi))
    return exp(x * x) * erfc(x)


def scaled_erfcx(s):
    if s > 1 - mpf(10) ** -12:
        return 2 / sqrt(pi)
    x = MIDDLE * (1 + s) / (1 - s)
    return (1 + 2 * x) * erfcx(x)


def scaled_erf(t):
    return erf(sqrt(t)) / sqrt(t) if t else 2 / sqrt(pi)


def nodes(low, high, count):
    return [(low + high) / 2 - (high - low) / 2 * cos(pi * mpf(i) / count) for i in range(count + 1)]


def extremes(samples):
    """The largest error of each run of one sign."""
    found = []
    for x, error in samples:
        if found and (found[-1][1] > 0) == (error > 0):
            if abs(error) > abs(found[-1][1]):
                found[-1] = (x, error)
        else:
            found.append((x, error))
    return found


def fit(function, degree, low, high):
    low, high = mpf(low), mpf(high)
    samples = [(x, function(x)) for x in nodes(low, high, 800)]
    points = [(x, function(x)) for x in nodes(low, high, degree + 1)]
    for _ in range(12):
        rows = [[x**j / value for j in range(degree + 1)] + [(-1) ** i] for i, (x, value) in enumerate(points)]
        solution = lu_solve(matrix(rows), matrix([1] * len(points)))
        coefficients = [solution[j] for j in range(degree + 1)]
        errors = [(x, sum(c * x**j for j, c in enumerate(coefficients)) / value - 1) for x, value in samples]
        largest = max(abs(error) for _, error in errors)
        alternating = extremes(errors)
        while len(alternating) > len(points):
            alternating.pop(0 if abs(alternating[0][1]) < abs(alternating[-1][1]) else -1)
        if largest < mpf(1.001) * abs(solution[degree + 1]) or len(alternating) < len(points):
            break
        points = [(x, function(x)) for x, _ in alternating]
    return coefficients[::-1], largest


def main():
    for name, function, degree, low, high in [
        ("erfcx(x) (1 + 2 x)", scaled_erfcx, 10, -1, 1),
        ("erf(x) / x", scaled_erf, 4, 0, 0.25),
    ]:
        coefficients, largest = fit(function, degree, low, high)
        print(name, [nstr(c, 9) for c in coefficients], "relative error", nstr(largest, 3))


if __name__ == "__main__":
    main()
