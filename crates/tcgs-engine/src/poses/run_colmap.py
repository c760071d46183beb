"""Finds the cameras of photographs with the program colmap, where Python has no pycolmap.

    python3 -I SCRIPT REQUEST.json
    python3 -I SCRIPT --probe PROGRAM

Requests and answers are those of estimate_poses.py, whose functions stand before these in the script. The request also has `colmap`, the
program, and `groups`, the photographs that share a camera. Python's own library is enough.
"""

import shutil
import sqlite3
import subprocess

# The oldest version whose commands are tried.
OLDEST = (3, 13)
PR_SET_PDEATHSIG, SIGKILL = 1, 9
# The contrast of the weakest feature that COLMAP keeps.
PEAK_THRESHOLD = 0.02 / 3
# Pixels of a photograph for which threads that look for features get memory.
MAX_PIXELS = 24_000_000


class CommandProgress(Progress):
    """Reports progress from what the program logs."""

    LINES = re.compile(Progress.LINES.pattern + r"|Registering (?:image|frame) #\d+ \((?:\w+=)?(\d+)\)")

    def tell(self, *numbers):
        *others, registered = numbers
        if self.stage == "mapping":
            say(stage=self.stage, done=min(registered, self.total), total=self.total)
        else:
            super().tell(*others)


def version_of(program):
    """The version that the program states; fails if it is too old or none."""
    try:
        told = subprocess.run([program, "help"], capture_output=True, text=True, errors="replace", timeout=60)
    except (OSError, subprocess.SubprocessError) as error:
        fail("unavailable", str(error))
    found = re.search(r"COLMAP (\d+)\.(\d+)(\.\d+)?", told.stdout + told.stderr)
    if not found:
        fail("unavailable", f"{program} does not tell its version")
    version = found.group().split()[1]
    if (int(found.group(1)), int(found.group(2))) < OLDEST:
        fail("unavailable", f"{program} is of version {version}, and {OLDEST[0]}.{OLDEST[1]} or newer is needed")
    return version


def end_with_this():
    ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, SIGKILL)


class Colmap:
    """Runs commands of the program."""

    def __init__(self, program):
        self.program = program

    def options(self, command):
        """The names of a command's options, which differ between versions."""
        told = subprocess.run([self.program, command, "-h"], capture_output=True, text=True, errors="replace")
        return set(re.findall(r"--([\w.]+)", told.stdout + told.stderr))

    def run(self, command, paths, wanted):
        """Runs a command with paths, and with those of the wanted options that it has: each by the first of its names that is known."""
        known = self.options(command)
        arguments = [self.program, command]
        for name, path in paths.items():
            arguments += [f"--{name}", str(path)]
        for names, value in wanted:
            name = next((name for name in names if name in known), None)
            if name:
                arguments += [f"--{name}", str(value)]
        # Standard output is for answers alone.
        child = subprocess.Popen(arguments, stdin=subprocess.DEVNULL, stdout=2, stderr=2, preexec_fn=end_with_this)
        return child.wait()

    def expect(self, command, paths, wanted):
        status = self.run(command, paths, wanted)
        if status != 0:
            fail("error", f"colmap {command} ended with status {status}")


def ask(database, question):
    opened = sqlite3.connect(f"file:{database}?mode=ro", uri=True)
    try:
        return opened.execute(question).fetchall()
    finally:
        opened.close()


def names_of(model):
    """The names of the photographs of a model in its binary form."""
    data = (model / "images.bin").read_bytes()
    (count,), at, names = struct.unpack_from("<Q", data), 8, []
    for _ in range(count):
        # A number, a rotation, a translation and the number of the camera.
        at += 4 + 7 * 8 + 4
        end = data.index(b"\0", at)
        names.append(data[at:end].decode("utf-8", "replace"))
        (points,) = struct.unpack_from("<Q", data, end + 1)
        at = end + 9 + 24 * points
    return sorted(names)


def count_of(file):
    return struct.unpack_from("<Q", file.read_bytes())[0]


def mean_error(model):
    data = (model / "points3D.bin").read_bytes()
    (count,), at, sum_of_errors = struct.unpack_from("<Q", data), 8, 0.0
    for _ in range(count):
        # A number, a place and a color stand before the error.
        error, track = struct.unpack_from("<dQ", data, at + 8 + 24 + 3)
        sum_of_errors += error
        at += 8 + 24 + 3 + 16 + 8 * track
    return sum_of_errors / max(count, 1)


def all_points(colmap, model, database, folder, work, seeds):
    """The model with its points found anew, as in estimate_poses.py; as it is where the program cannot."""
    more = work / "points"
    more.mkdir(exist_ok=True)
    paths = {"database_path": database, "image_path": folder, "input_path": model, "output_path": more}
    paths |= {"clear_points": 1, "refine_intrinsics": 0}
    wanted = [(["Mapper.tri_ignore_two_view_tracks"], 0), (["Mapper.num_threads"], 1)]
    is_done = colmap.run("point_triangulator", paths, wanted + seeds) == 0 and (more / "images.bin").exists()
    return more if is_done else model


def main():
    is_probe = sys.argv[1] == "--probe"
    request = None if is_probe else json.loads(Path(sys.argv[1]).read_text(encoding="utf-8"))
    network = leave_network()
    if is_probe:
        say(engine="colmap", version=version_of(sys.argv[2]), network=network)
        return
    limit_memory(request["memory_bytes"])
    end_with_parent()
    held = wait_for_folder(Path(request["work"]))
    version = version_of(request["colmap"])
    progress, colmap = CommandProgress(), Colmap(request["colmap"])
    say(engine="colmap", version=version, network=network)

    folder, work, names = Path(request["photographs"]), Path(request["work"]), request["names"]
    seed, threads, database = request["seed"], request["threads"], work / "features.db"
    seeds = [(["default_random_seed", "random_seed"], seed)]
    progress.begin("features", len(names))
    listed = work / "photographs.txt"
    extracting = feature_threads(threads, request["memory_bytes"], MAX_PIXELS)
    for group in request["groups"]:
        listed.write_text("".join(f"{name}\n" for name in group), encoding="utf-8")
        paths = {"database_path": database, "image_path": folder, "image_list_path": listed}
        if request["masks"]:
            paths["ImageReader.mask_path"] = request["masks"]
        wanted = [
            (["ImageReader.camera_model"], request["camera_model"]),
            (["ImageReader.single_camera"], 1),
            (["FeatureExtraction.num_threads", "SiftExtraction.num_threads"], extracting),
            (["FeatureExtraction.use_gpu", "SiftExtraction.use_gpu"], 0),
            (["FeatureExtraction.max_image_size", "SiftExtraction.max_image_size"], MAX_FEATURE_SIDE),
            (["SiftExtraction.peak_threshold"], PEAK_SHARE * PEAK_THRESHOLD),
        ]
        colmap.expect("feature_extractor", paths, wanted + seeds)
        progress.before += len(group)
    progress.end()
    counts = dict(ask(database, "SELECT name, rows FROM images JOIN keypoints USING (image_id)"))
    check_features(names, counts)

    matching = [
        (["FeatureMatching.num_threads", "SiftMatching.num_threads"], 1),
        (["FeatureMatching.use_gpu", "SiftMatching.use_gpu"], 0),
        (["TwoViewGeometry.random_seed"], seed),
    ]
    if is_exhaustive(request["matching"], names):
        progress.begin("matches", len(names) * (len(names) - 1) // 2)
        blocks = [(["ExhaustivePairing.block_size", "ExhaustiveMatching.block_size"], BLOCK)]
        colmap.expect("exhaustive_matcher", {"database_path": database}, matching + blocks + seeds)
    else:
        loops = loop_pairs(names)
        progress.begin("matches", len(names) + len(loops))
        colmap.expect("sequential_matcher", {"database_path": database}, matching + seeds)
        pairs = work / "loops.txt"
        pairs.write_text("".join(f"{a} {b}\n" for a, b in loops), encoding="utf-8")
        paths = {"database_path": database, "match_list_path": pairs, "match_type": "pairs"}
        colmap.expect("matches_importer", paths, matching + seeds)
    progress.end()
    verified = ask(database, "SELECT COUNT(*) FROM two_view_geometries WHERE rows > 0")[0][0]
    check_pairs(verified)

    progress.begin("mapping", len(names))
    models = work / "models"
    models.mkdir()
    wanted = [
        (["Mapper.num_threads"], 1),
        (["Mapper.random_seed"], seed),
        (["Mapper.min_model_size"], 3),
        (["Mapper.ba_use_gpu"], 0),
    ]
    status = colmap.run(
        "mapper", {"database_path": database, "image_path": folder, "output_path": models}, wanted + seeds
    )
    found = [model for model in models.iterdir() if (model / "images.bin").exists()]
    if not found:
        if status < 0:
            fail("error", f"colmap mapper was ended by signal {-status}")
        if status != 0:
            print(f"colmap mapper ended with status {status}", file=sys.stderr)
        fail("no-overlap", "no two photographs overlap enough, from places far enough apart, to begin with")
    model = max(sorted(found), key=lambda model: len(names_of(model)))
    error = mean_error(model)
    model = all_points(colmap, model, database, folder, work, seeds)
    target = work / "sparse" / "0"
    target.mkdir(parents=True)
    paths = {"image_path": folder, "input_path": model, "output_path": target, "method": "IMAGE-ORIENTATION"}
    # The cameras' common up to -y; without one the model stays as it is.
    if colmap.run("model_orientation_aligner", paths, []) != 0 or not (target / "images.bin").exists():
        shutil.copytree(model, target, dirs_exist_ok=True)
    registered = names_of(target)
    say(stage="mapping", done=len(registered), total=len(names), reprojection_error=error)
    say(
        result={
            "registered": registered,
            "models": len(found),
            "points": count_of(target / "points3D.bin"),
            "cameras": count_of(target / "cameras.bin"),
            "reprojection_error": error,
            "verified_pairs": verified,
        }
    )
    held.close()


if __name__ == "__main__":
    try:
        main()
    except Exception as error:
        fail("error", f"{type(error).__name__}: {error}")
