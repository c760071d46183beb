//! The child process that finds cameras, and the lines of JSON that it answers with.

use std::{
    env,
    ffi::OsStr,
    fs::{self, File},
    io::{Read as _, Seek as _, SeekFrom},
    path::{Path, PathBuf},
    process::{Command, Stdio},
    sync::mpsc::{Receiver, RecvTimeoutError},
    time::{Duration, Instant},
};

use serde::{Deserialize, Serialize};

use super::{
    NetworkIsolation, PoseLimits, PoseOptions, PoseProgram, PoseProgress, PoseReport, PosesError,
    keep_alive::REPORT_AGAIN, room::full_disk_or, running::Running,
};
use crate::{
    domain::CancelFlag,
    ingest::{IngestErrorKind, Limits},
};

/// The program that the child runs.
const SCRIPT: &str = include_str!("estimate_poses.py");

/// What it runs instead where there is no pycolmap.
const COLMAP_SCRIPT: &str = include_str!("run_colmap.py");

/// The script that runs colmap: behind the functions of the other, without the lines that start that.
fn colmap_script() -> String {
    let shared = SCRIPT.rsplit_once("if __name__ ").map_or(SCRIPT, |(functions, _)| functions);
    format!("{shared}{COLMAP_SCRIPT}")
}

/// COLMAP's own program: the one that `TCGS_COLMAP` names, else `colmap`.
#[must_use]
pub fn find_colmap() -> PathBuf {
    let named = env::var_os("TCGS_COLMAP").filter(|path| !path.is_empty());
    named.map_or_else(|| PathBuf::from("colmap"), PathBuf::from)
}

/// How often the caller's wish to stop is looked at.
const POLL: Duration = Duration::from_millis(100);

/// Most bytes of the child's own messages that an error repeats.
const MAX_MESSAGE: u64 = 1000;

/// Names of photographs that an error repeats.
const EXAMPLES: usize = 5;

/// The interpreter to use: `chosen`, else that of the environment which `make poses` makes, else `python3`.
#[must_use]
pub fn find_python(chosen: Option<&Path>) -> PathBuf {
    let data = env::var_os("XDG_DATA_HOME").filter(|path| !path.is_empty()).map(PathBuf::from);
    let data = data.or_else(|| env::home_dir().map(|home| home.join(".local/share")));
    let own = data.map(|data| data.join("tcgs/poses/bin/python3")).filter(|path| path.exists());
    chosen.map(Path::to_owned).or(own).unwrap_or_else(|| PathBuf::from("python3"))
}

/// Finds cameras with an interpreter, within limits.
#[derive(Debug, Clone)]
pub struct PoseEstimator {
    /// A Python that has pycolmap, or any if there is a colmap.
    pub python: PathBuf,
    /// COLMAP's own program, which is used if Python has no pycolmap.
    pub colmap: PathBuf,
    /// The program that takes frames of videos.
    pub ffmpeg: PathBuf,
    /// What the child may use.
    pub limits: PoseLimits,
}

/// The folder of masks in the folder of a search, the database of features and matches, and what these are of.
pub(super) const MASKS: &str = "masks";
const DATABASE: [&str; 3] = ["features.db", "features.db-wal", "features.db-shm"];
const IDENTITY: &str = "search.json";

/// The folders that a search writes after that.
const RESULTS: [&str; 3] = ["models", "points", "sparse"];

/// What a database of features and matches is of, besides the photographs themselves.
#[derive(Serialize)]
struct Identity<'a> {
    names: &'a [String],
    camera_model: &'a str,
    matching: &'a str,
    seed: u64,
}

impl<'a> Identity<'a> {
    fn new(names: &'a [String], options: PoseOptions) -> Self {
        let PoseOptions { camera_model, matching, seed, .. } = options;
        Self { names, camera_model: camera_model.name(), matching: matching.name(), seed }
    }
}

/// Removes the results of an earlier search from a folder, and its features and matches unless they are of the same search.
fn forget_others(work: &Path, identity: &Identity<'_>) -> std::io::Result<()> {
    let (path, identity) = (work.join(IDENTITY), serde_json::to_vec(identity)?);
    let is_same = fs::read(&path).is_ok_and(|before| before == identity);
    let absent = |error: &std::io::Error| error.kind() == std::io::ErrorKind::NotFound;
    for name in RESULTS {
        fs::remove_dir_all(work.join(name))
            .or_else(|error| if absent(&error) { Ok(()) } else { Err(error) })?;
    }
    for name in DATABASE.into_iter().filter(|_| !is_same) {
        fs::remove_file(work.join(name)).or_else(|error| if absent(&error) { Ok(()) } else { Err(error) })?;
    }
    fs::write(path, identity)
}

#[derive(Serialize)]
struct Request<'a> {
    photographs: &'a Path,
    names: &'a [String],
    work: &'a Path,
    /// Of the photograph NAME, the file NAME.png is black where it is ignored.
    masks: Option<PathBuf>,
    camera_model: String,
    matching: &'a str,
    seed: u64,
    threads: usize,
    memory_bytes: u64,
    /// For colmap alone: the program, and photographs that share a camera.
    #[serde(skip_serializing_if = "Option::is_none")]
    colmap: Option<&'a Path>,
    #[serde(skip_serializing_if = "Vec::is_empty")]
    groups: Vec<Vec<&'a str>>,
}

/// A line of the child's.
#[derive(Debug, Deserialize)]
#[serde(untagged)]
enum Line {
    Progress(PoseProgress),
    Result { result: Found },
    Failure { failure: String, detail: String },
    Program(PoseProgram),
}

#[derive(Debug, Deserialize)]
struct Found {
    registered: Vec<String>,
    models: usize,
    points: u64,
    cameras: u64,
    reprojection_error: f64,
    verified_pairs: u64,
}

impl PoseEstimator {
    /// Runs pycolmap, or colmap if there is none, for nothing but its version and the means that keep it off the network.
    ///
    /// # Errors
    /// [`PosesError::Unavailable`], for want of pycolmap.
    pub fn probe(&self) -> Result<PoseProgram, PosesError> {
        self.probe_with(SCRIPT, &[]).or_else(|error| match self.probe_colmap() {
            Ok(program) => Ok(program),
            Err(other) => {
                tracing::debug!("there is no colmap either: {other}");
                Err(error)
            }
        })
    }

    fn probe_colmap(&self) -> Result<PoseProgram, PosesError> {
        self.probe_with(&colmap_script(), &[self.colmap.as_os_str()])
    }

    fn probe_with(&self, script: &str, program: &[&OsStr]) -> Result<PoseProgram, PosesError> {
        let unavailable = |detail| PosesError::Unavailable { python: self.python.clone(), detail };
        let mut command = Command::new(&self.python);
        let asked = command.args(["-I", "-c", script, "--probe"]).args(program).stdin(Stdio::null()).output();
        let asked = asked.map_err(|error| unavailable(error.to_string()))?;
        let lines = String::from_utf8_lossy(&asked.stdout).into_owned();
        for line in lines.lines() {
            match serde_json::from_str(line) {
                Ok(Line::Program(program)) => return Ok(program),
                Ok(Line::Failure { detail, .. }) => return Err(unavailable(detail)),
                _ => {}
            }
        }
        let errors = String::from_utf8_lossy(&asked.stderr);
        Err(unavailable(errors.lines().last().unwrap_or("it said nothing").to_owned()))
    }

    /// Finds the cameras of the photographs `names` below the folder `photographs`, in this order. `work` is a folder that nothing else
    /// writes to, where the model and temporary files are written. If a folder `masks` is there, what its masks hide is ignored. A search
    /// that was interrupted there goes on with the features and matches that it had.
    ///
    /// # Errors
    /// Why cameras were not found. If fewer than half of them were, the model is not used.
    pub fn estimate(
        &self,
        photographs: &Path,
        names: &[String],
        work: &Path,
        options: PoseOptions,
        report: &mut dyn FnMut(PoseProgress),
        cancel: &CancelFlag,
    ) -> Result<PoseReport, PosesError> {
        if names.len() < Limits::MIN_PHOTOGRAPHS {
            return Err(PosesError::Ingest(IngestErrorKind::TooFewPhotographs(names.len()).into()));
        }
        let io = |what| move |error| PosesError::Io { what, error };
        let folder = fs::canonicalize(work).map_err(io("cannot find the folder to work in"))?;
        let mut request = Request {
            photographs: &fs::canonicalize(photographs).map_err(io("cannot find the photographs"))?,
            names,
            work: &folder,
            masks: Some(folder.join(MASKS)).filter(|masks| masks.is_dir()),
            camera_model: options.camera_model.colmap_name(),
            matching: options.matching.name(),
            seed: options.seed,
            threads: options.threads,
            memory_bytes: self.limits.memory_bytes,
            colmap: None,
            groups: Vec::new(),
        };
        forget_others(work, &Identity::new(names, options))
            .map_err(io("cannot clear the folder to work in"))?;
        let mut answer = self.run(SCRIPT, &request, work, report, cancel);
        if matches!(answer, Err(PosesError::Unavailable { .. })) && self.probe_colmap().is_ok() {
            request.colmap = Some(&self.colmap);
            request.groups = by_size(photographs, names);
            answer = self.run(&colmap_script(), &request, work, report, cancel);
        }
        let (found, generator, is_network_isolated) = answer?;
        let unregistered: Vec<String> =
            names.iter().filter(|name| found.registered.binary_search(name).is_err()).cloned().collect();
        if found.registered.len() < Limits::MIN_PHOTOGRAPHS || 2 * found.registered.len() < names.len() {
            return Err(PosesError::TooFewRegistered {
                registered: found.registered.len(),
                photographs: names.len(),
                examples: unregistered[..unregistered.len().min(EXAMPLES)].join(", "),
            });
        }
        Ok(PoseReport {
            photographs: names.len(),
            registered: found.registered,
            unregistered,
            models: found.models,
            points: found.points,
            cameras: found.cameras,
            reprojection_error: found.reprojection_error,
            verified_pairs: found.verified_pairs,
            generator,
            is_network_isolated,
            options,
            model: work.join("sparse/0"),
        })
    }

    /// Runs a script with a request in `work`; what it found, with the program's name and whether it had no network.
    fn run(
        &self,
        script: &str,
        request: &Request<'_>,
        work: &Path,
        report: &mut dyn FnMut(PoseProgress),
        cancel: &CancelFlag,
    ) -> Result<(Found, String, bool), PosesError> {
        let io = |what| move |error| PosesError::Io { what, error };
        let (path, asked) = (work.join("find_cameras.py"), work.join("request.json"));
        let text = serde_json::to_vec(request).expect("a request has string keys and plain values");
        fs::write(&path, script).map_err(io("cannot write the program"))?;
        fs::write(&asked, text).map_err(io("cannot write the request"))?;
        let messages = File::create(work.join("messages.txt")).map_err(io("cannot write the messages"))?;
        let child = Command::new(&self.python)
            .arg("-I")
            .args([&path, &asked])
            .env("OMP_NUM_THREADS", request.threads.to_string())
            .stdin(Stdio::null())
            .stdout(Stdio::piped())
            .stderr(messages)
            .spawn();
        let child = child.map_err(|error| PosesError::Unavailable {
            python: self.python.clone(),
            detail: error.to_string(),
        })?;
        let mut running = Running(child);
        let answer = match self.follow(&running.lines(), report, cancel) {
            Err(error @ PosesError::Died { .. }) => return Err(full_disk_or(error, work)),
            answer => answer?,
        };
        let status = running.0.wait().map_err(io("cannot wait for the search for cameras"))?;
        answer.ok_or_else(|| {
            let detail = last_words(&work.join("messages.txt"));
            full_disk_or(PosesError::Died { status: status.to_string(), detail }, work)
        })
    }

    /// Passes progress on until the child's output ends; what it found, with the program's name and whether it had no network.
    fn follow(
        &self,
        lines: &Receiver<String>,
        report: &mut dyn FnMut(PoseProgress),
        cancel: &CancelFlag,
    ) -> Result<Option<(Found, String, bool)>, PosesError> {
        let end = Instant::now() + self.limits.time;
        let (mut generator, mut is_isolated, mut found) = ("pycolmap".to_owned(), false, None);
        let (mut last, mut reported) = (None, Instant::now());
        loop {
            if cancel.is_cancelled() {
                return Err(PosesError::Cancelled);
            }
            if Instant::now() >= end {
                return Err(PosesError::TimedOut(self.limits.time));
            }
            let text = match lines.recv_timeout(POLL) {
                Ok(text) => text,
                Err(RecvTimeoutError::Timeout) => {
                    // It has a limit of time of its own, so it does not count as stalled while it works on one step.
                    if let Some(last) = last.filter(|_| reported.elapsed() > REPORT_AGAIN) {
                        report(last);
                        reported = Instant::now();
                    }
                    continue;
                }
                Err(RecvTimeoutError::Disconnected) => break,
            };
            match serde_json::from_str(&text) {
                Ok(Line::Progress(progress)) => {
                    report(progress);
                    (last, reported) = (Some(progress), Instant::now());
                }
                Ok(Line::Result { result }) => found = Some(result),
                Ok(Line::Failure { failure, detail }) => return Err(self.failure(&failure, detail)),
                Ok(Line::Program(program)) => {
                    generator = program.to_string();
                    is_isolated = program.network != NetworkIsolation::None;
                }
                // COLMAP's libraries may write there too.
                Err(_) => tracing::debug!("the search for cameras: {text}"),
            }
        }
        Ok(found.map(|found| (found, generator, is_isolated)))
    }

    fn failure(&self, failure: &str, detail: String) -> PosesError {
        match failure {
            "unavailable" => PosesError::Unavailable { python: self.python.clone(), detail },
            "unreadable" => PosesError::Unreadable(detail),
            "featureless" => PosesError::Featureless(detail),
            "no-overlap" => PosesError::NoOverlap(detail),
            _ => PosesError::Died { status: failure.to_owned(), detail },
        }
    }
}

/// Photographs by their size in pixels, in the order of the first of each: colmap is not told more of devices.
fn by_size<'a>(folder: &Path, names: &'a [String]) -> Vec<Vec<&'a str>> {
    type Size = Option<(u32, u32)>;
    let mut groups: Vec<(Size, Vec<&str>)> = Vec::new();
    for name in names {
        let size = image::image_dimensions(folder.join(name)).ok();
        match groups.iter_mut().find(|(of, _)| *of == size) {
            Some((_, group)) => group.push(name),
            None => groups.push((size, vec![name])),
        }
    }
    groups.into_iter().map(|(_, group)| group).collect()
}

/// The end of a file, on one line.
pub(super) fn last_words(path: &Path) -> String {
    let read = || -> std::io::Result<String> {
        let mut file = File::open(path)?;
        let length = file.metadata()?.len();
        file.seek(SeekFrom::Start(length.saturating_sub(MAX_MESSAGE)))?;
        let mut bytes = Vec::new();
        file.take(MAX_MESSAGE).read_to_end(&mut bytes)?;
        Ok(String::from_utf8_lossy(&bytes).split_whitespace().collect::<Vec<_>>().join(" "))
    };
    read().ok().filter(|text| !text.is_empty()).unwrap_or_else(|| "it said nothing".to_owned())
}
