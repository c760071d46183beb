"""Prints the Gaussians of a .usda as usd-core reads them, as one JSON document; rotations as x, y, z, w."""

import json
import sys

from pxr import Usd, UsdGeom, UsdVol

stage = Usd.Stage.Open(sys.argv[1])
prim = stage.GetDefaultPrim()
assert prim.IsA(UsdVol.ParticleField3DGaussianSplat), prim.GetTypeName()


def numbers(name):
    values = prim.GetAttribute(name).Get()
    assert values is not None, f"{name} is missing"
    return values


def flat(name):
    return [part for row in numbers(name) for part in row]


rotations = [part for q in numbers("orientations") for part in (*q.GetImaginary(), q.GetReal())]
json.dump(
    {
        "up": UsdGeom.GetStageUpAxis(stage),
        "meters": UsdGeom.GetStageMetersPerUnit(stage),
        "degree": numbers("radiance:sphericalHarmonicsDegree"),
        "positions": flat("positions"),
        "scales": flat("scales"),
        "opacities": list(numbers("opacities")),
        "orientations": rotations,
        "coefficients": flat("radiance:sphericalHarmonicsCoefficients"),
    },
    sys.stdout,
)
