"""The Gaussians that a camera sees of a `.tcgs` file of version 1, by section 12 of FORMAT.md, in plain Python and floats of 64 bits.
Prints a JSON list: for each anchor in the file's order and each slot null, or opacity, mean, deviations, quaternion and colour.

    python3 tests/oracles/gaussians.py FILE X Y Z
"""

import json
import math
import sys

from decoder import decode


def logistic(value):
    return 1 / (1 + math.exp(-value))


def network(layers, values):
    for index, (inputs, outputs, weights, bias) in enumerate(layers):
        if index:
            values = [max(value, 0.0) for value in values]
        rows = [weights[row * inputs : (row + 1) * inputs] for row in range(outputs)]
        values = [sum(w * x for w, x in zip(row, values)) + b for row, b in zip(rows, bias)]
    return values


def harmonics(degree, x, y, z):
    if degree > 1:
        yield from (math.sqrt(3) * x * y, -math.sqrt(3) * y * z, (2 * z * z - x * x - y * y) / 2)
        yield from (-math.sqrt(3) * x * z, math.sqrt(3) / 2 * (x * x - y * y))
    if degree > 2:
        outer, inner, ring = math.sqrt(5 / 8), math.sqrt(3 / 8), 4 * z * z - x * x - y * y
        yield from (-outer * y * (3 * x * x - y * y), math.sqrt(15) * x * y * z, -inner * y * ring)
        yield z * (2 * z * z - 3 * x * x - 3 * y * y) / 2
        yield from (-inner * x * ring, math.sqrt(15) / 2 * z * (x * x - y * y), -outer * x * (x * x - 3 * y * y))


def gaussians(scene, anchor, eye):
    position, scalings, offsets = scene["positions"][anchor], scene["scalings"][anchor], scene["offsets"][anchor]
    away = [p - c for p, c in zip(position, eye)]
    distance = math.sqrt(sum(d * d for d in away))
    direction = [d / distance for d in away]
    given = [*scene["features"][anchor], *direction, distance, *harmonics(scene["degree"], *direction)]
    opacity, shape, color = (network(layers, given) for layers in scene["networks"])
    for k in range(scene["K"]):
        alpha = math.tanh(opacity[k])
        if not scene["masks"][anchor][k] or alpha <= 0:
            yield None
            continue
        s = shape[7 * k : 7 * k + 7]
        mean = [p + o * r for p, o, r in zip(position, offsets[3 * k : 3 * k + 3], scalings[:3])]
        deviations = [logistic(v) * size for v, size in zip(s[:3], scalings[3:])]
        length = math.sqrt(sum(v * v for v in s[3:]))
        yield [alpha, *mean, *deviations, *(v / length for v in s[3:]), *map(logistic, color[3 * k : 3 * k + 3])]


def main(path, *eye):
    with open(path, "rb") as file:
        _, _, scene = decode(file.read())
    eye = [float(value) for value in eye]
    print(json.dumps([list(gaussians(scene, anchor, eye)) for anchor in range(len(scene["positions"]))]))


if __name__ == "__main__":
    main(*sys.argv[1:])
