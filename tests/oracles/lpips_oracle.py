"""Writes lpips.json: LPIPS by the `lpips` package in f64, on weights and images that the Rust test makes alike.

    pip install torch torchvision lpips==0.1.4
    python tests/oracles/lpips_oracle.py

Weights and images come from SplitMix64, so neither needs a file: tensor number i of a network (in the order of its state
below) is the stream with seed 1000 * network + i, network 1 being AlexNet and 2 VGG16.
"""

import json
import math
import pathlib

import lpips
import numpy as np
import torch

PAIRS = {"alex": [(64, 48), (71, 131)], "vgg": [(48, 32), (35, 75)]}
NUMBER = {"alex": 1, "vgg": 2}


def splitmix(seed, count):
    """The first `count` numbers of SplitMix64."""
    with np.errstate(over="ignore"):
        z = np.uint64(seed) + np.arange(1, count + 1, dtype=np.uint64) * np.uint64(0x9E3779B97F4A7C15)
        z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
        return z ^ (z >> np.uint64(31))


def uniform(seed, shape, low, high):
    """f32 values in [low, high) from the upper 24 bits, computed in f64."""
    unit = (splitmix(seed, math.prod(shape)) >> np.uint64(40)).astype(np.float64) / 2**24
    return (low + (high - low) * unit).astype(np.float32).reshape(shape)


def weights(net, state):
    """Random values for the tensors of `state`: He-uniform kernels, small biases, heads that are not negative."""
    names = [name for name in state if name.startswith(("net.", "lin")) and not name.startswith("lins.")]
    filled = {}
    for index, name in enumerate(names):
        shape = tuple(state[name].shape)
        if name.startswith("lin"):
            low, high = 0.0, 1.0
        elif name.endswith("bias"):
            low, high = -0.1, 0.1
        else:
            high = math.sqrt(6.0 / math.prod(shape[1:]))
            low = -high
        filled[name] = torch.from_numpy(uniform(1000 * NUMBER[net] + index, shape, low, high))
    return filled


def images(width, height):
    """A coloured gradient, and the same with every third sample disturbed."""
    y, x, c = np.meshgrid(np.arange(height), np.arange(width), np.arange(3), indexing="ij")
    clean = ((x * (5 + c) + y * (9 - 3 * c) + 40 * c) % 256).astype(np.uint8)
    noise = (splitmix(7, clean.size) >> np.uint64(58)).astype(np.uint8).reshape(clean.shape)
    disturbed = np.arange(clean.size).reshape(clean.shape) % 3 == 0
    return clean, np.where(disturbed, clean ^ noise, clean)


def tensor(image):
    return torch.from_numpy(image.astype(np.float64) / 255.0).permute(2, 0, 1)[None]


def main():
    expected = []
    for net in ["alex", "vgg"]:
        metric = lpips.LPIPS(net=net, version="0.1", pretrained=False, pnet_rand=True, verbose=False)
        state = weights(net, metric.state_dict())
        left = metric.load_state_dict(state, strict=False)
        # The scaling layer keeps its constants, and `lins` are the heads again.
        assert not left.unexpected_keys
        assert all(name.startswith(("scaling_layer.", "lins.")) for name in left.missing_keys)
        metric = metric.double().eval()
        for width, height in PAIRS[net]:
            a, b = (tensor(image) for image in images(width, height))
            with torch.no_grad():
                total, layers = metric(a, b, retPerLayer=True, normalize=True)
            layers = [layer.item() for layer in layers]
            expected.append({"net": net, "width": width, "height": height, "layers": layers, "total": total.item()})
            print(expected[-1])
    path = pathlib.Path(__file__).with_name("lpips.json")
    path.write_text(json.dumps(expected, indent=1) + "\n")


if __name__ == "__main__":
    main()
