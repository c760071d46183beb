//! `tcgs poses`: makes a dataset of photographs without cameras.

use std::{
    env, fs, io,
    path::{Path, PathBuf},
    thread,
    time::{Duration, Instant},
};

use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};
use tcgs::{
    domain::{Bytes, Problem, ProblemType},
    ingest,
    poses::{
        CameraModel, Matching, PoseEstimator, PoseLimits, PoseOptions, PoseProgress, PoseReport, PoseStage,
        PosesError, find_python, natural_order,
    },
};
use tempfile::TempDir;

use super::{CliError, Report, memory::MemoryFlags, notice::notice, signals::Interruption, wiring};

/// Time between two lines of one stage, where standard error is no terminal.
const LINE_INTERVAL: Duration = Duration::from_secs(5);

/// Minutes after which a search is given up.
const DEFAULT_MINUTES: u32 = 240;

/// Names of photographs without a camera that are printed.
const NAMED: usize = 10;

/// Arguments of `tcgs poses`.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// Folder of photographs: JPEG, PNG or WebP, also in folders of its own
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
    };
    let search = Search::new(args.python.as_deref(), args.host_memory, args.time_limit, options);
    let (found, dataset) = search.dataset(&args.photographs, work.path(), &Interruption::listen())?;
    if is_zip {
        let mut archive =
            fs::File::create_new(&args.output).map_err(|error| CliError::unwritable(&args.output, &error))?;
        wiring::pack(&dataset, &mut archive)?;
    } else {
        // An empty folder gives way.
        fs::rename(&dataset, &args.output).map_err(|error| CliError::unwritable(&args.output, &error))?;
    }
    let ending = format!("wrote {0}; train it with: tcgs train {0} -o scene.tcgs", args.output.display());
    Ok(Report::new(text(&found) + &ending, &found))
}

/// A temporary folder in `parent`.
pub(super) fn work_folder(parent: &Path) -> Result<TempDir, CliError> {
    let folder = tempfile::Builder::new().prefix(".tcgs-poses-").tempdir_in(parent);
    folder.map_err(|error| CliError::unwritable(parent, &error))
}

fn all_threads() -> usize {
    thread::available_parallelism().map_or(1, usize::from)
}

/// A search for cameras.
pub(super) struct Search {
    estimator: PoseEstimator,
    options: PoseOptions,
}

impl Search {
    /// With what the flags of `tcgs poses` are by default.
    pub(super) fn usual() -> Self {
        let python = env::var_os("TCGS_POSES_PYTHON").filter(|path| !path.is_empty()).map(PathBuf::from);
        let options = PoseOptions {
            camera_model: CameraModel::SimpleRadial,
            matching: Matching::Auto,
            seed: 0,
            threads: all_threads(),
        };
        Self::new(python.as_deref(), None, DEFAULT_MINUTES, options)
    }

    fn new(python: Option<&Path>, host_memory: Option<Bytes>, minutes: u32, options: PoseOptions) -> Self {
        let limits = PoseLimits {
            memory_bytes: MemoryFlags::host(host_memory),
            time: Duration::from_secs(60) * minutes,
        };
        Self { estimator: PoseEstimator { python: find_python(python), limits }, options }
    }

    /// Finds the cameras of the photographs in a folder, and makes a dataset below `work`, which is empty.
    pub(super) fn dataset(
        &self,
        given: &Path,
        work: &Path,
        interruption: &Interruption,
    ) -> Result<(PoseReport, PathBuf), CliError> {
        let (folder, mut names) = photographs(given)?;
        names.sort_by(|a, b| natural_order(a, b));
        let mut display = Display::new();
        let report = &mut |progress| display.show(progress);
        let found =
            self.estimator.estimate(&folder, &names, work, self.options, report, &interruption.cancel);
        display.finish();
        let found = found.map_err(|error| match error {
            PosesError::Cancelled => interruption.error("nothing was written".to_owned()),
            error => Problem::from(error).in_file(given.display().to_string()).into(),
        })?;
        let dataset = work.join("dataset");
        assemble(&dataset, &folder, &found).map_err(|error| CliError::unwritable(&dataset, &error))?;
        Ok((found, dataset))
    }
}

/// The folder that the photographs are in, and their names below it.
fn photographs(given: &Path) -> Result<(PathBuf, Vec<String>), CliError> {
    let mut names =
        ingest::photographs(given).map_err(|problem| problem.in_file(given.display().to_string()))?;
    let mut folder = given.to_owned();
    while let Some((first, _)) = names.first().and_then(|name| name.split_once('/')) {
        let prefix = format!("{first}/");
        if !names.iter().all(|name| name.starts_with(&prefix)) {
            break;
        }
        folder.push(first);
        names.iter_mut().for_each(|name| *name = name[prefix.len()..].to_owned());
    }
    Ok((folder, names))
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

/// Puts the registered photographs and the model into a folder, in COLMAP's layout. Photographs are linked where the file system can.
fn assemble(dataset: &Path, folder: &Path, found: &PoseReport) -> io::Result<()> {
    for name in &found.registered {
        let to = dataset.join("images").join(name);
        fs::create_dir_all(to.parent().unwrap_or(dataset))?;
        if fs::hard_link(folder.join(name), &to).is_err() {
            fs::copy(folder.join(name), &to)?;
        }
    }
    fs::create_dir_all(dataset.join("sparse"))?;
    fs::rename(&found.model, dataset.join("sparse/0"))
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

    fn show(&mut self, PoseProgress { stage, done, total }: PoseProgress) {
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
    fn photographs_in_one_folder_have_names_below_it() {
        let folder = tempfile::tempdir().expect("a folder");
        let put = |name: &str| {
            let path = folder.path().join(name);
            fs::create_dir_all(path.parent().expect("a parent")).expect("a folder");
            fs::write(path, b"").expect("a file");
        };
        put("take/images/a.jpg");
        put("take/images/left/b.jpg");
        let (root, mut names) = photographs(folder.path()).expect("readable");
        names.sort_unstable();
        assert_eq!(names, ["a.jpg", "left/b.jpg"]);
        assert!(root.ends_with("take/images"));
        put("c.png");
        let (root, names) = photographs(folder.path()).expect("readable");
        assert_eq!((root.as_path(), names.len()), (folder.path(), 3));
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
