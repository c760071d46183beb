//! `tcgs poses`: makes a dataset of photographs without cameras.

use std::{
    fs, io,
    path::{Path, PathBuf},
    time::{Duration, Instant},
};

use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};
use tcgs::{
    domain::{Bytes, MaskMode, MaskSource, Problem, ProblemType},
    poses::{
        CameraModel, DEFAULT_FRAMES, Given, Matching, PoseOptions, PoseProgress, PoseReport, PoseStage,
        PosedDataset, PosesError,
    },
    worker::CameraSearch,
};
use tempfile::{TempDir, TempPath};

use super::{
    CliError, Report,
    camera_search::{DEFAULT_MINUTES, all_threads, camera_search},
    notice::notice,
    signals::Interruption,
    wiring,
};

/// Time between two lines of one stage, where standard error is no terminal.
const LINE_INTERVAL: Duration = Duration::from_secs(5);

/// Names of photographs without a camera that are printed.
const NAMED: usize = 10;

/// Arguments of `tcgs poses`.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// Folder or zip of photographs (JPEG, PNG or WebP), or a video (MP4 or MOV)
    photographs: PathBuf,

    /// The dataset to write: a new folder, or a new file whose name ends in .zip
    #[arg(short, long, value_name = "DATASET")]
    output: PathBuf,

    /// COLMAP's model of the cameras; photographs of one device, lens and size share a camera
    #[arg(long, value_name = "MODEL", default_value = "simple-radial", value_parser = clap::builder::PossibleValuesParser::new(CameraModel::NAMES))]
    camera_model: String,

    /// Pairs that are compared: exhaustive (all), sequential (for frames of a video), auto (all of up to 200 photographs)
    #[arg(long, default_value = "auto", value_parser = clap::builder::PossibleValuesParser::new(Matching::NAMES))]
    matching: String,

    /// Masks of photographs, whose hidden parts place no cameras: auto finds them by their names; none ignores them
    #[arg(long, value_name = "auto|none|FOLDER", default_value = "auto")]
    masks: MaskSource,

    /// What masks mean; those that cut out an object are left out of the search
    #[arg(long, default_value = "auto", value_parser = clap::builder::PossibleValuesParser::new(MaskMode::NAMES))]
    mask_mode: String,

    /// Frames of a video that are taken, at even steps, the sharpest of each
    #[arg(long, value_name = "N", default_value_t = DEFAULT_FRAMES, value_parser = frames)]
    frames: usize,

    /// Seed of all random numbers
    #[arg(long, value_name = "N", default_value_t = 0)]
    seed: u64,

    /// Threads [default: all]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u16).range(1..))]
    threads: Option<u16>,

    /// Give up after this time
    #[arg(long, value_name = "MINUTES", default_value_t = DEFAULT_MINUTES, value_parser = clap::value_parser!(u32).range(1..))]
    time_limit: u32,

    /// Python with pycolmap [default: the one that `make poses` installs, else python3]
    #[arg(long, value_name = "PROGRAM", env = "TCGS_POSES_PYTHON")]
    python: Option<PathBuf>,

    /// Main memory that the search may take, such as 6GiB [default: three quarters of what is available]
    #[arg(long, value_name = "BYTES", env = "TCGS_HOST_MEMORY")]
    host_memory: Option<Bytes>,

    /// Print what was found as one JSON document
    #[arg(long)]
    pub(super) json: bool,
}

/// Finds the cameras and writes the dataset.
pub(crate) fn run(args: &Args) -> Result<Report, CliError> {
    let is_zip = args.output.extension().is_some_and(|extension| extension.eq_ignore_ascii_case("zip"));
    check_new(&args.output)?;
    let parent = args.output.parent().filter(|parent| !parent.as_os_str().is_empty());
    // Beside the output, so that the finished dataset is moved there at once.
    let work = work_folder(parent.unwrap_or(Path::new(".")))?;
    let options = PoseOptions {
        camera_model: args.camera_model.parse().map_err(CliError::Usage)?,
        matching: args.matching.parse().map_err(CliError::Usage)?,
        seed: args.seed,
        threads: args.threads.map_or_else(all_threads, usize::from),
        frames: args.frames,
    };
    let mask_mode: MaskMode = args.mask_mode.parse().map_err(CliError::Usage)?;
    let masks = if mask_mode == MaskMode::CutOut { MaskSource::None } else { args.masks.clone() };
    let search = camera_search(args.python.as_deref(), args.host_memory, args.time_limit, options);
    let search = CameraSearch { masks, ..search };
    let (found, dataset) = dataset(&search, &args.photographs, work.path(), &Interruption::listen())?;
    if is_zip {
        write_zip(&dataset, work.path(), &args.output)?;
    } else {
        // An empty folder gives way.
        fs::rename(&dataset, &args.output).map_err(|error| CliError::unwritable(&args.output, &error))?;
    }
    let ending = format!("wrote {0}; train it with: tcgs train {0} -o scene.tcgs", args.output.display());
    Ok(Report::new(text(&found) + &ending, &found))
}

/// Packs a dataset in the folder `work`, which is beside the output, and moves the zip there once it is whole.
fn write_zip(dataset: &Path, work: &Path, output: &Path) -> Result<(), CliError> {
    let unwritable = |error: io::Error| CliError::unwritable(output, &error);
    let path = work.join("packed.zip");
    let mut archive = fs::File::create_new(&path).map_err(unwritable)?;
    wiring::pack(dataset, &mut archive)?;
    archive.sync_all().map_err(unwritable)?;
    let packed = TempPath::try_from_path(path).map_err(unwritable)?;
    packed.persist_noclobber(output).map_err(|error| unwritable(error.error))
}

/// A temporary folder in `parent`.
pub(super) fn work_folder(parent: &Path) -> Result<TempDir, CliError> {
    let folder = tempfile::Builder::new().prefix(".tcgs-poses-").tempdir_in(parent);
    folder.map_err(|error| CliError::unwritable(parent, &error))
}

/// Most frames of a video: with more, ffmpeg's choice of them has no place in a command line.
const MAX_FRAMES: usize = 2000;

fn frames(text: &str) -> Result<usize, String> {
    let range = format!("is not 3 to {MAX_FRAMES}");
    text.parse().ok().filter(|count| (3..=MAX_FRAMES).contains(count)).ok_or(range)
}

/// Finds the cameras of photographs or of a video, and makes a dataset below `work`, which is empty.
pub(super) fn dataset(
    search: &CameraSearch,
    given: &Path,
    work: &Path,
    interruption: &Interruption,
) -> Result<(PoseReport, PathBuf), CliError> {
    let mut display = Display::new();
    let report = &mut |progress| display.show(progress);
    let CameraSearch { estimator, options, masks } = search;
    let found = estimator.dataset(Given { path: given, masks }, work, *options, report, &interruption.cancel);
    display.finish();
    let PosedDataset { report, folder } = found.map_err(|error| match error {
        PosesError::Cancelled => interruption.error("nothing was written".to_owned()),
        error => {
            let problem = Problem::from(error);
            let is_named = problem.file.is_some();
            let named = if is_named { problem } else { problem.in_file(given.display().to_string()) };
            CliError::from(named)
        }
    })?;
    Ok((report, folder))
}

fn check_new(output: &Path) -> Result<(), CliError> {
    let is_free = match fs::read_dir(output) {
        Ok(mut entries) => entries.next().is_none(),
        Err(error) => error.kind() == io::ErrorKind::NotFound,
    };
    if is_free {
        return Ok(());
    }
    let detail = "the output exists; name a folder that is new or empty, or a new file".to_owned();
    Err(Problem::new(ProblemType::Exists, detail).in_file(output.display().to_string()).into())
}

/// What was found, for people.
pub(super) fn text(found: &PoseReport) -> String {
    let PoseReport { photographs, registered, unregistered, points, cameras, reprojection_error, .. } = found;
    let devices = if *cameras == 1 { "one device".to_owned() } else { format!("{cameras} devices") };
    let mut text = format!(
        "cameras   of {} of {photographs} photographs, which {devices} took\n\
         points    {points}, {reprojection_error:.2} px from where photographs show them\n\
         found by  {}, seed {}, {} threads, network {}\n",
        registered.len(),
        found.generator,
        found.options.seed,
        found.options.threads,
        if found.is_network_isolated { "cut off" } else { "not cut off" },
    );
    if found.models > 1 {
        text.push_str(&format!("models    {}; the largest was taken\n", found.models));
    }
    if !unregistered.is_empty() {
        let named = unregistered[..unregistered.len().min(NAMED)].join(", ");
        let more = unregistered.len().saturating_sub(NAMED);
        let more = if more > 0 { format!(" and {more} more") } else { String::new() };
        text.push_str(&format!("left out  {named}{more}\n"));
    }
    text
}

/// Progress on standard error: a bar on a terminal, lines elsewhere.
struct Display {
    bar: ProgressBar,
    last: Option<(PoseStage, Instant)>,
}

impl Display {
    fn new() -> Self {
        let bar = ProgressBar::with_draw_target(Some(0), ProgressDrawTarget::stderr());
        let style = ProgressStyle::with_template("{prefix:>8} [{bar:28}] {pos}/{len}");
        Self {
            bar: style.map_or(bar.clone(), |style| bar.with_style(style.progress_chars("=> "))),
            last: None,
        }
    }

    fn show(&mut self, PoseProgress { stage, done, total, .. }: PoseProgress) {
        self.bar.set_prefix(stage.name());
        self.bar.set_length(total);
        self.bar.set_position(done);
        let is_due = self.last.is_none_or(|(shown, at)| shown != stage || at.elapsed() >= LINE_INTERVAL);
        if self.bar.is_hidden() && is_due {
            self.last = Some((stage, Instant::now()));
            notice(format_args!("{} {done}/{total}", stage.name()));
        }
    }

    fn finish(&self) {
        self.bar.finish_and_clear();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_zip_is_there_whole_or_not_at_all() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = |name: &str| folder.path().join(name);
        fs::create_dir_all(path("dataset/images")).expect("a folder");
        fs::write(path("dataset/images/1.jpg"), b"a photograph").expect("a file");
        let work = || work_folder(folder.path()).expect("a folder");
        write_zip(&path("missing"), work().path(), &path("a.zip")).expect_err("there is nothing to pack");
        assert!(!path("a.zip").exists());
        write_zip(&path("dataset"), work().path(), &path("a.zip")).expect("writes");
        let whole = fs::read(path("a.zip")).expect("a zip");
        assert!(whole.starts_with(b"PK"));
        write_zip(&path("dataset"), work().path(), &path("a.zip")).expect_err("another one is there by now");
        assert_eq!(fs::read(path("a.zip")).expect("a zip"), whole);
    }

    #[test]
    fn an_output_is_new_or_an_empty_folder() {
        let folder = tempfile::tempdir().expect("a folder");
        assert!(check_new(folder.path()).is_ok() && check_new(&folder.path().join("new")).is_ok());
        fs::write(folder.path().join("file"), b"").expect("a file");
        for taken in [folder.path(), &folder.path().join("file")] {
            assert_eq!(check_new(taken).expect_err("taken").exit_status(), 3);
        }
    }
}
