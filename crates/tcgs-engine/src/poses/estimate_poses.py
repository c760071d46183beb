"""Finds the cameras of photographs with pycolmap: features, matches, incremental mapping.

    python3 -I estimate_poses.py REQUEST.json
    python3 -I estimate_poses.py --probe

The probe tells the version and the means that keep the process off the network. The request has `photographs` (a folder), `names` (files
below it, in order), `masks` (a folder or null; of NAME, NAME.png hides where it is black), `work` (a folder for this alone, perhaps with
the database of an interrupted search), `camera_model`, `matching` (`auto`, `exhaustive`, `sequential`), `seed`, `threads`,
`memory_bytes` (0 for no limit). Standard output has one JSON object a line: `{"stage", "done", "total"}` as work goes on, of the finished
mapping with `reprojection_error` in pixels, and at the end `{"result"}` or `{"failure", "detail"}`. The result's model is in
`work/sparse/0`. pycolmap and numpy alone are needed.
"""

import collections
import ctypes
import json
import os
import re
import statistics
import struct
import sys
import threading
import time
from pathlib import Path

# Photographs up to which every pair is matched.
MAX_EXHAUSTIVE = 200
# Frames of a longer sequence that are matched with each other, so that loops close.
KEY_FRAMES = 60
# Longest side, in pixels, at which features are looked for.
MAX_FEATURE_SIDE = 1600
# Contrast of the weakest feature, as a share of COLMAP's own: a scene starts from the points, and twice the features give half as many more.
PEAK_SHARE = 0.5
# Memory of the process itself, and of each thread that looks for features: at most MAX_FEATURE_SIDE of a photograph of so many pixels.
BASE_MEMORY, FEATURE_MEMORY, PIXEL_MEMORY = 256 << 20, 448 << 20, 6
# Fewest features of a usable photograph, in the median.
MIN_FEATURES = 100
# Photographs whose pairs are matched between two reports of progress.
BLOCK = 10

CLONE_NEWUSER, CLONE_NEWNET = 0x10000000, 0x40000000
PR_SET_SECCOMP, PR_SET_NO_NEW_PRIVS, SECCOMP_MODE_FILTER = 22, 38, 2
# Numbers of the architecture (AUDIT_ARCH_*) and of the system calls socket, socketpair and io_uring_setup, by machine.
SYSTEM_CALLS = {"x86_64": (0xC000003E, (41, 53, 425)), "aarch64": (0xC00000B7, (198, 199, 425))}


def say(**message):
    print(json.dumps(message), flush=True)


def fail(failure, detail):
    say(failure=failure, detail=detail)
    sys.exit(0)


def leave_network():
    """Keeps the process off the network: in a network namespace of its own, which has no interfaces, else by a filter of system calls.
    Returns which of them the system permits: `namespace`, `filter` or `none`."""
    try:
        libc = ctypes.CDLL(None, use_errno=True)
        if libc.unshare(CLONE_NEWNET) == 0 or libc.unshare(CLONE_NEWUSER | CLONE_NEWNET) == 0:
            return "namespace"
        return "filter" if refuse_sockets(libc) else "none"
    except (OSError, AttributeError):
        return "none"


def refuse_sockets(libc):
    """Lets the system calls that make sockets fail with EPERM (seccomp); returns whether the system permits that."""
    if os.uname().machine not in SYSTEM_CALLS:
        return False
    architecture, calls = SYSTEM_CALLS[os.uname().machine]
    load, equal, at_least, answer = 0x20, 0x15, 0x35, 0x06
    allow, refuse, kill = 0x7FFF0000, 0x00050000 | 1, 0x80000000
    # Each: code, jump if true, jump if false, value. The architecture stands at 4, the number of the call at 0; numbers of the
    # 32-bit interface of x86-64 begin at 0x40000000.
    program = [(load, 0, 0, 4), (equal, 1, 0, architecture), (answer, 0, 0, kill), (load, 0, 0, 0)]
    program += [(at_least, len(calls) + 1, 0, 0x40000000)]
    program += [(equal, len(calls) - place, 0, call) for place, call in enumerate(calls)]
    program += [(answer, 0, 0, allow), (answer, 0, 0, refuse)]
    instructions = b"".join(struct.pack("=HBBI", *instruction) for instruction in program)
    held = ctypes.create_string_buffer(instructions, len(instructions))
    described = struct.pack("@HP", len(program), ctypes.addressof(held))
    if libc.prctl(PR_SET_NO_NEW_PRIVS, 1, 0, 0, 0) != 0:
        return False
    return libc.prctl(PR_SET_SECCOMP, SECCOMP_MODE_FILTER, described, 0, 0) == 0


def limit_memory(number):
    if number:
        import resource

        resource.setrlimit(resource.RLIMIT_DATA, (number, number))


def end_with_parent():
    """Ends the process once its parent has: the work is of no use to anybody then."""
    parent = os.getppid()

    def watch():
        while os.getppid() == parent:
            time.sleep(1.0)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def wait_for_folder(work):
    """Waits until no earlier process works in the folder: one whose parent has died ends within a second. Returns what holds it."""
    import fcntl

    held = open(work / "lock", "w")
    fcntl.flock(held, fcntl.LOCK_EX)
    return held


class Progress:
    """Reports progress from what COLMAP's libraries log, which is passed on. They tell it nowhere else: its database belongs to them
    while they work."""

    LINES = re.compile(r"Processed file \[(\d+)/(\d+)\]|Processing block \[(\d+)/(\d+), (\d+)/(\d+)\]|Processing image \[(\d+)/(\d+)\]")

    def __init__(self):
        self.stage, self.total, self.before = None, 0, 0
        self.log = os.fdopen(os.dup(2), "w", errors="replace")
        reading, writing = os.pipe()
        os.dup2(writing, 2)
        os.close(writing)
        threading.Thread(target=self.read, args=(reading,), daemon=True).start()

    def begin(self, stage, total):
        self.stage, self.total, self.before = stage, total, 0
        say(stage=stage, done=0, total=total)

    def end(self):
        say(stage=self.stage, done=self.total, total=self.total)

    def read(self, pipe):
        with os.fdopen(pipe, errors="replace") as lines:
            for line in lines:
                self.log.write(line)
                self.log.flush()
                found = self.LINES.search(line)
                if found:
                    self.tell(*(int(number) if number else 0 for number in found.groups()))

    def tell(self, file, _files, row, rows, column, columns, image, images):
        if self.stage == "features" and file:
            say(stage=self.stage, done=min(self.before + file, self.total), total=self.total)
        elif self.stage == "matches" and rows:
            # A block is logged as it begins.
            share = ((row - 1) * columns + column - 1) / (rows * columns)
            say(stage=self.stage, done=int(self.total * share), total=self.total)
        elif self.stage == "matches" and images:
            say(stage=self.stage, done=int(self.total * (image - 1) / images), total=self.total)


def devices(pycolmap, folder, names):
    """Names by the device, lens and size that EXIF and pixels tell: each group shares one camera. Also the pixels of the largest."""
    groups = collections.OrderedDict()
    for name in names:
        bitmap = pycolmap.Bitmap.read(folder / name, True)
        if bitmap is None:
            fail("unreadable", f"{name} is not a photograph that pycolmap can read")
        size = (bitmap.width, bitmap.height)
        exif = [str(value) for value in (bitmap.exif_camera_model(), bitmap.exif_focal_length())]
        groups.setdefault((size, *exif), []).append(name)
    return list(groups.values()), max(width * height for (width, height), *_ in groups)


def feature_threads(threads, memory, pixels):
    """As many threads as there is memory for, at least one."""
    if not memory:
        return threads
    return max(1, min(threads, (memory - BASE_MEMORY) // (FEATURE_MEMORY + PIXEL_MEMORY * pixels)))


def loop_pairs(names):
    """Pairs of key frames, evenly spread, that sequential matching leaves out. COLMAP's lists of pairs have no names with spaces."""
    names = [name for name in names if not any(character.isspace() for character in name)]
    count = min(KEY_FRAMES, len(names))
    keys = [names[index * len(names) // count] for index in range(count)]
    return [(a, b) for place, a in enumerate(keys) for b in keys[place + 1 :]]


def all_points(pycolmap, model, database, folder, work, seed):
    """The model with points found anew from its cameras, those of only two photographs among them. Mapping leaves these out, since they
    would not hold cameras; a scene starts from them."""
    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads = options.mapper.num_threads = 1
    options.random_seed = options.mapper.random_seed = options.triangulation.random_seed = seed
    options.triangulation.ignore_two_view_tracks = False
    to = work / "points"
    to.mkdir(exist_ok=True)
    return pycolmap.triangulate_points(pycolmap.Reconstruction(model), database, folder, to, True, options, False)


def check_features(names, features):
    """Ends the search of photographs of which half have too few features; `features` has their numbers by name."""
    if statistics.median([features.get(name, 0) for name in names]) >= MIN_FEATURES:
        return
    weakest = min(names, key=lambda name: features.get(name, 0))
    fail(
        "featureless",
        f"half of the photographs have fewer than {MIN_FEATURES} distinct points (fewest: {weakest} with {features.get(weakest, 0)})",
    )


def is_exhaustive(matching, names):
    return matching == "exhaustive" or (matching == "auto" and len(names) <= MAX_EXHAUSTIVE)


def check_pairs(verified):
    if verified == 0:
        fail("no-overlap", "no two photographs show the same things")


def upright(pycolmap, numpy, model):
    """Turns the model so that the common up of its cameras is -y, as of a level first camera."""
    ups = [-image.cam_from_world().rotation.matrix()[1] for image in model.images.values() if image.has_pose]
    up = numpy.mean(ups, axis=0)
    if numpy.linalg.norm(up) < 0.3:
        # Cameras all around a point have none in common.
        return
    up = up / numpy.linalg.norm(up)
    target = numpy.array([0.0, -1.0, 0.0])
    axis, cosine = numpy.cross(up, target), float(up @ target)
    if cosine < -0.999999:
        matrix = numpy.diag([1.0, -1.0, -1.0])
    else:
        cross = numpy.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
        matrix = numpy.eye(3) + cross + cross @ cross / (1.0 + cosine)
    model.transform(pycolmap.Sim3d(1.0, pycolmap.Rotation3d(matrix), numpy.zeros(3)))


def main():
    is_probe = sys.argv[1] == "--probe"
    request = None if is_probe else json.loads(Path(sys.argv[1]).read_text(encoding="utf-8"))
    network = leave_network()
    if is_probe:
        try:
            import numpy
            import pycolmap
        except ImportError as error:
            fail("unavailable", str(error))
        say(version=pycolmap.__version__, network=network)
        return
    limit_memory(request["memory_bytes"])
    end_with_parent()
    held = wait_for_folder(Path(request["work"]))
    progress = Progress()
    try:
        import numpy
        import pycolmap
    except ImportError as error:
        fail("unavailable", str(error))
    say(version=pycolmap.__version__, network=network)

    folder, work, names = Path(request["photographs"]), Path(request["work"]), request["names"]
    seed, threads, database = request["seed"], request["threads"], work / "features.db"
    pycolmap.set_random_seed(seed)

    reader = pycolmap.ImageReaderOptions()
    reader.camera_model = request["camera_model"]
    if request["masks"]:
        reader.mask_path = request["masks"]
    extraction = pycolmap.FeatureExtractionOptions()
    extraction.max_image_size, extraction.use_gpu = MAX_FEATURE_SIDE, False
    extraction.sift.peak_threshold *= PEAK_SHARE
    progress.begin("features", len(names))
    opened = pycolmap.Database.open(database)
    known = opened.num_images()
    opened.close()
    if 0 < known < len(names):
        # Interrupted before features were looked for.
        database.unlink()
        pycolmap.Database.open(database).close()
    groups, pixels = devices(pycolmap, folder, names)
    extraction.num_threads = feature_threads(threads, request["memory_bytes"], pixels)
    # Photographs that have features, and pairs that were compared, are not done again.
    for group in groups if known < len(names) else []:
        # In order, since numbers of photographs decide which come first; extraction would number them as threads finish.
        pycolmap.import_images(
            database, folder, camera_mode=pycolmap.CameraMode.SINGLE, image_names=group, options=reader
        )
    for group in groups:
        pycolmap.extract_features(
            database,
            folder,
            image_names=group,
            camera_mode=pycolmap.CameraMode.SINGLE,
            reader_options=reader,
            extraction_options=extraction,
            device=pycolmap.Device.cpu,
        )
        progress.before += len(group)
    progress.end()
    opened = pycolmap.Database.open(database)
    features = {image.name: opened.num_keypoints_for_image(image.image_id) for image in opened.read_all_images()}
    opened.close()
    check_features(names, features)

    matching = pycolmap.FeatureMatchingOptions()
    matching.num_threads, matching.use_gpu = 1, False
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = seed
    options = {"matching_options": matching, "verification_options": verification, "device": pycolmap.Device.cpu}
    if is_exhaustive(request["matching"], names):
        progress.begin("matches", len(names) * (len(names) - 1) // 2)
        pairing = pycolmap.ExhaustivePairingOptions()
        pairing.block_size = BLOCK
        pycolmap.match_exhaustive(database, pairing_options=pairing, **options)
    else:
        pairing = pycolmap.SequentialPairingOptions()
        pairing.num_threads = threads
        loops = loop_pairs(names)
        progress.begin("matches", len(names) * 2 * pairing.overlap + len(loops))
        pycolmap.match_sequential(database, pairing_options=pairing, **options)
        pairs = work / "loops.txt"
        pairs.write_text("".join(f"{a} {b}\n" for a, b in loops), encoding="utf-8")
        imported = pycolmap.ImportedPairingOptions()
        imported.match_list_path = pairs
        pycolmap.match_image_pairs(database, pairing_options=imported, **options)
    progress.end()
    opened = pycolmap.Database.open(database)
    verified = opened.num_verified_image_pairs()
    opened.close()
    check_pairs(verified)

    mapping = pycolmap.IncrementalPipelineOptions()
    mapping.num_threads, mapping.random_seed = 1, seed
    mapping.min_model_size = 3
    mapping.mapper.num_threads = 1
    mapping.mapper.random_seed = mapping.triangulation.random_seed = seed
    registered = 0

    def initial():
        nonlocal registered
        registered = 2
        say(stage="mapping", done=registered, total=len(names))

    def following():
        nonlocal registered
        registered += 1
        say(stage="mapping", done=min(registered, len(names)), total=len(names))

    say(stage="mapping", done=0, total=len(names))
    models = pycolmap.incremental_mapping(
        database,
        folder,
        work / "models",
        options=mapping,
        initial_image_pair_callback=initial,
        next_image_callback=following,
    )
    if not models:
        fail("no-overlap", "no two photographs overlap enough, from places far enough apart, to begin with")
    model = max(models.values(), key=lambda model: model.num_reg_images())
    # Of the points that hold the cameras: those of two photographs nearly always agree.
    error = model.compute_mean_reprojection_error()
    model = all_points(pycolmap, model, database, folder, work, seed)
    upright(pycolmap, numpy, model)
    (work / "sparse" / "0").mkdir(parents=True)
    model.write(work / "sparse" / "0")
    say(stage="mapping", done=model.num_reg_images(), total=len(names), reprojection_error=error)
    found = sorted(image.name for image in model.images.values() if image.has_pose)
    say(
        result={
            "registered": found,
            "models": len(models),
            "points": model.num_points3D(),
            "cameras": model.num_cameras(),
            "reprojection_error": error,
            "verified_pairs": verified,
        }
    )


if __name__ == "__main__":
    try:
        main()
    except Exception as error:
        fail("error", f"{type(error).__name__}: {error}")
