"""Makes wavelet.json: Haar bands of small images and their mean distances, by PyWavelets.

    pip install PyWavelets==1.8.0 numpy
    python tests/oracles/wavelet.py > tests/oracles/wavelet.json

Renders are multiples of 1/1024, which f32 holds exactly; photographs are 8-bit. Arrays are [row][column][channel].
`bands` are those of the render: `low` of the second level and, from the finest level on, LH, HL, HH (PyWavelets' cH,
cV, cD). `l1` are the mean absolute differences of the photograph's bands from them, in the same order.
"""

import json

import numpy as np
import pywt

SIZES = [(5, 7), (9, 4), (1, 1), (8, 8), (6, 10), (3, 2), (1, 13), (11, 6)]


def transform(image):
    half, fine = pywt.dwt2(image, "haar", mode="zero", axes=(0, 1))
    low, coarse = pywt.dwt2(half, "haar", mode="zero", axes=(0, 1))
    return {"low": low, "fine": list(fine), "coarse": list(coarse)}


def combine(function, *parts):
    """`function` of corresponding bands, in the same structure."""
    return {
        name: [function(*bands) for bands in zip(*(part[name] for part in parts))]
        if isinstance(value, list)
        else function(*(part[name] for part in parts))
        for name, value in parts[0].items()
    }


def case(rng, height, width):
    photograph = rng.integers(0, 256, (height, width, 3))
    render = rng.integers(-64, 1100, (height, width, 3))
    a, b = transform(render / 1024), transform(photograph / 255)
    return {
        "width": width,
        "height": height,
        "render_1024": render.ravel().tolist(),
        "photograph": photograph.ravel().tolist(),
        "bands": combine(lambda band: band.ravel().tolist(), a),
        "l1": combine(lambda p, q: float(np.mean(np.abs(p - q))), a, b),
    }


def main():
    rng = np.random.default_rng(5)
    cases = ",\n".join(json.dumps(case(rng, height, width)) for width, height in SIZES)
    print(f'{{"made_with": "PyWavelets {pywt.__version__}", "cases": [\n{cases}\n]}}')


if __name__ == "__main__":
    main()
