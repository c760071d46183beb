"""Makes the committed values of the splatting and entropy oracles from whole ones: keeps the tensors that tests read, of the
entropy oracle every fourth row, and deflates them.

    python3 tests/oracles/prune.py ORACLES tests/oracles

ORACLES is a folder of `.safetensors`, one a case, computed with the pure-PyTorch reference of gsplat (Apache-2.0, commit 90d7b4b)
in f64, with `entropy/entropy.safetensors` beside them.
"""

import gzip
import json
import struct
import sys
from pathlib import Path

WIDTH = {"F32": 4, "F64": 8, "I32": 4, "I64": 8}
SPLATTING = "rgb alpha ids v_means v_quats v_scales v_opacities v_sh v_means2d v_conics".split()
ENTROPY = "x mu sigma q bits d_x d_sigma d_q".split()
EVERY = 4


def read(path):
    data = path.read_bytes()
    (length,) = struct.unpack("<Q", data[:8])
    header, body = json.loads(data[8 : 8 + length]), data[8 + length :]
    header.pop("__metadata__", None)
    return {name: (t["dtype"], t["shape"], body[slice(*t["data_offsets"])]) for name, t in header.items()}


def write(tensors, path):
    header, body = {}, b""
    for name, (dtype, shape, data) in tensors.items():
        header[name] = {"dtype": dtype, "shape": shape, "data_offsets": [len(body), len(body) + len(data)]}
        body += data
    text = json.dumps(header, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 8)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(gzip.compress(struct.pack("<Q", len(text)) + text + body, 9, mtime=0))


def thinned(tensor):
    dtype, shape, data = tensor
    width = WIDTH[dtype]
    rows = [data[row * width : (row + 1) * width] for row in range(0, shape[0], EVERY)]
    return dtype, [len(rows)], b"".join(rows)


def main(source, target):
    for path in sorted(source.glob("*.safetensors")):
        kept = {n: t for n, t in read(path).items() if n.startswith("in.") or n.removeprefix("f64.") in SPLATTING}
        write(kept, target / "splatting" / f"{path.name}.gz")
    entropy = read(source / "entropy" / "entropy.safetensors")
    write({name: thinned(entropy[name]) for name in ENTROPY}, target / "entropy.safetensors.gz")


main(Path(sys.argv[1]), Path(sys.argv[2]))
