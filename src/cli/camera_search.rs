//! The search for cameras that flags and variables of the environment describe.

use std::{
    env,
    path::{Path, PathBuf},
    thread,
    time::Duration,
};

use tcgs::{
    domain::{Bytes, MaskSource},
    poses::{
        CameraModel, DEFAULT_FRAMES, Matching, PoseEstimator, PoseLimits, PoseOptions, find_colmap,
        find_ffmpeg, find_python,
    },
    worker::CameraSearch,
};

use super::memory::MemoryFlags;

/// Minutes after which a search is given up.
pub(super) const DEFAULT_MINUTES: u32 = 240;

/// The programs with which workers find cameras.
#[derive(Debug, Clone, PartialEq, Eq, clap::Args)]
pub(crate) struct CameraFlags {
    /// Python with pycolmap, which finds the cameras of photographs [default: the one that `make poses` installs, else python3]
    #[arg(long, value_name = "PROGRAM", env = "TCGS_POSES_PYTHON")]
    pub(crate) poses_python: Option<PathBuf>,

    /// The program that takes photographs from videos [default: ffmpeg]
    #[arg(long, value_name = "PROGRAM", env = "TCGS_FFMPEG")]
    pub(crate) ffmpeg: Option<PathBuf>,
}

impl CameraFlags {
    /// The search of a worker within `host_memory`.
    pub(crate) fn search(&self, host_memory: Bytes) -> CameraSearch {
        let mut search = usual_camera_search(Some(host_memory));
        let estimator = &mut search.estimator;
        estimator.python = find_python(self.poses_python.as_deref());
        estimator.ffmpeg = self.ffmpeg.clone().unwrap_or_else(find_ffmpeg);
        search
    }
}

/// A search with these options; the interpreter and the memory are the usual ones where they are not named.
pub(super) fn camera_search(
    python: Option<&Path>,
    host_memory: Option<Bytes>,
    minutes: u32,
    options: PoseOptions,
) -> CameraSearch {
    let limits =
        PoseLimits { memory_bytes: MemoryFlags::host(host_memory), time: Duration::from_secs(60) * minutes };
    let estimator =
        PoseEstimator { python: find_python(python), colmap: find_colmap(), ffmpeg: find_ffmpeg(), limits };
    CameraSearch { estimator, options, masks: MaskSource::Auto }
}

/// The search with what the flags of `tcgs poses` are by default.
pub(super) fn usual_camera_search(host_memory: Option<Bytes>) -> CameraSearch {
    let python = env::var_os("TCGS_POSES_PYTHON").filter(|path| !path.is_empty()).map(PathBuf::from);
    let options = PoseOptions {
        camera_model: CameraModel::SimpleRadial,
        matching: Matching::Auto,
        seed: 0,
        threads: all_threads(),
        frames: DEFAULT_FRAMES,
    };
    camera_search(python.as_deref(), host_memory, DEFAULT_MINUTES, options)
}

pub(super) fn all_threads() -> usize {
    thread::available_parallelism().map_or(1, usize::from)
}
