"""Projections of points by every camera model of COLMAP, as pycolmap computes them: python cameras.py > cameras.json

Needs pycolmap 4.2.1. Points are in front of the camera and within the image of each model; pixels are those of pycolmap.Camera.
"""

import json
import math

import pycolmap

WIDTH, HEIGHT = 640, 480
F, FX, FY, CX, CY = 420.0, 410.0, 430.0, 323.5, 236.25

PARAMETERS = {
    "SIMPLE_PINHOLE": [F, CX, CY],
    "PINHOLE": [FX, FY, CX, CY],
    "SIMPLE_RADIAL": [F, CX, CY, -0.08],
    "RADIAL": [F, CX, CY, 0.06, -0.03],
    "OPENCV": [FX, FY, CX, CY, -0.06, 0.02, 0.003, -0.002],
    "OPENCV_FISHEYE": [FX, FY, CX, CY, -0.03, 0.012, -0.004, 0.0008],
    "FULL_OPENCV": [FX, FY, CX, CY, 0.31, -0.05, 0.003, -0.002, 0.01, 0.35, 0.02, -0.003],
    "FOV": [FX, FY, CX, CY, 0.9],
    "SIMPLE_RADIAL_FISHEYE": [F, CX, CY, -0.04],
    "RADIAL_FISHEYE": [F, CX, CY, -0.04, 0.01],
    "THIN_PRISM_FISHEYE": [FX, FY, CX, CY, -0.03, 0.012, 0.002, -0.001, -0.004, 0.0008, 0.0015, -0.0012],
    "RAD_TAN_THIN_PRISM_FISHEYE": [
        FX, FY, CX, CY, -0.03, 0.012, -0.004, 0.0008, -0.0001, 0.00002, 0.002, -0.001, 0.0015, -0.0003, -0.0012, 0.0002,
    ],
    "SIMPLE_DIVISION": [F, CX, CY, -0.12],
    "DIVISION": [FX, FY, CX, CY, -0.2],
    "SIMPLE_FISHEYE": [F, CX, CY],
    "FISHEYE": [FX, FY, CX, CY],
    "EUCM": [FX, FY, CX, CY, 0.6, 1.1],
}


def points():
    yield [0.0, 0.0, 1.0]
    yield [1e-9, -1e-9, 1.0]
    for ring, angle in enumerate([2, 12, 25, 35, 44]):
        for step in range(5):
            turn = math.radians(72 * step + 13 * ring)
            sine, cosine = math.sin(math.radians(angle)), math.cos(math.radians(angle))
            depth = 1.0 + 0.5 * step
            yield [depth * sine * math.cos(turn), depth * sine * math.sin(turn), depth * cosine]


def main():
    rows = []
    known = [name for name, model in pycolmap.CameraModelId.__members__.items() if int(model) >= 0]
    assert set(known) == {*PARAMETERS, "EQUIRECTANGULAR"}, known
    for name, parameters in PARAMETERS.items():
        camera = pycolmap.Camera(model=name, width=WIDTH, height=HEIGHT, params=parameters)
        pixels = []
        for point in points():
            pixel = camera.img_from_cam(point)
            assert pixel is not None, (name, point)
            pixels.append([float(value) for value in pixel])
        number = int(pycolmap.CameraModelId.__members__[name])
        rows.append({"model": name, "number": number, "parameters": parameters, "pixels": pixels})
    document = {"pycolmap": pycolmap.__version__, "size": [WIDTH, HEIGHT], "points": list(points()), "cameras": rows}
    print("{")
    print(f'"pycolmap": {json.dumps(document["pycolmap"])}, "size": {document["size"]},')
    print(f'"points": {json.dumps(document["points"])},')
    print('"cameras": [\n' + ",\n".join(json.dumps(row) for row in rows) + "\n]}")


if __name__ == "__main__":
    main()
