//! `tcgs eval --suite`: every model on every set of a folder, with equal steps and with equal seconds.
//!
//! The seconds of a set are those that its slowest model took for the equal steps; the others run again with as many steps
//! as fit into them, found by at most three runs (`seconds.rs`). Every finished run is kept in
//! `runs.jsonl` at once, and a suite that is started again continues where it was interrupted.

mod codec_table;
pub(in crate::cli) mod entry;
pub(in crate::cli) mod external_formats;
mod record;
mod seconds;
pub(in crate::cli) mod sets;
mod table;

use std::{
    collections::BTreeMap,
    fs,
    path::{Path, PathBuf},
};

use serde_json::json;
use tcgs::{
    domain::{CancelFlag, Dataset, ModelKind, Phase, Problem, ProblemType, TrainOptions},
    pipeline::{Checkpoints, JobError, JobOutput, Pipeline, RunJob as _},
};

use self::{
    entry::Entry,
    record::{Comparison, Record, Wanted},
};
use super::{
    CliError, Report, adapter::AdapterFlag, files, json_lines::JsonLines, lpips::LpipsFlag,
    memory::MemoryFlags, options::SuiteFlags, progress::Display, train::cancel_on_interrupt, wiring,
};

/// Where results go if no folder is named.
const OUT: &str = "out/suite";

/// Most runs of one entry at equal seconds.
const MAX_TRIES: usize = 3;

/// Arguments of a suite.
#[derive(Debug, clap::Args)]
#[group(id = "suite_of_runs")]
pub(crate) struct Args {
    /// Train and measure models on every dataset in this folder, instead of measuring one file
    #[arg(long, value_name = "DIR", conflicts_with_all = ["file", "save"])]
    pub(crate) suite: Option<PathBuf>,

    /// Models to compare: 3dgs, scaffold, tcgs, tcgs-PART without a part of the method, tcgs+PART with a part
    /// that is off in short runs, tcgs@LAMBDA with another lambda
    #[arg(long, value_name = "LIST", value_delimiter = ',', requires = "suite")]
    models: Vec<Entry>,

    /// Datasets to use, by name [default: all]
    #[arg(long, value_name = "LIST", value_delimiter = ',', requires = "suite")]
    sets: Vec<String>,

    /// Iterations for single datasets, instead of --iterations
    #[arg(long, value_name = "SET=N,…", value_delimiter = ',', value_parser = set_steps, requires = "suite")]
    steps: Vec<(String, u32)>,

    /// Script that converts the .ply of 3dgs to other programs' formats and back, such as scripts/external_formats.sh, to measure
    /// them too
    #[arg(long, value_name = "SCRIPT", requires = "suite")]
    external_formats: Option<PathBuf>,

    /// Compare with equal steps only
    #[arg(long, requires = "suite")]
    steps_only: bool,

    /// Folder of the results: results.json, results.md, and runs.jsonl, from which an interrupted suite continues
    #[arg(long, value_name = "DIR", default_value = OUT, requires = "suite")]
    out: PathBuf,

    /// Document to update: the tables replace what is between its markers
    #[arg(long, value_name = "FILE.md", requires = "suite")]
    table: Option<PathBuf>,

    #[command(flatten)]
    options: SuiteFlags,
}

impl Args {
    /// Whether a flag is given that needs a suite. `requires` does not catch it, because a file conflicts with `--suite`.
    pub(crate) fn is_used(&self) -> bool {
        let listed = !(self.models.is_empty() && self.sets.is_empty() && self.steps.is_empty());
        let named = self.table.is_some()
            || self.external_formats.is_some()
            || self.steps_only
            || self.out != Path::new(OUT);
        listed || named || self.options != SuiteFlags::default()
    }
}

fn set_steps(text: &str) -> Result<(String, u32), String> {
    let (set, steps) = text.split_once('=').ok_or("give SET=STEPS")?;
    Ok((set.to_owned(), steps.parse().map_err(|_| format!("'{steps}' is not a number of steps"))?))
}

/// Runs all entries that have no record yet and writes the tables.
pub(crate) fn run(
    args: &Args,
    folder: &Path,
    adapter: &AdapterFlag,
    lpips: &LpipsFlag,
) -> Result<Report, CliError> {
    let entries = if args.models.is_empty() { Entry::defaults() } else { args.models.clone() };
    let shared = args.options.validated()?;
    let asked: Vec<&str> =
        args.sets.iter().map(String::as_str).chain(args.steps.iter().map(|(set, _)| set.as_str())).collect();
    let named: Vec<&str> = args.sets.iter().map(String::as_str).collect();
    let sets = sets::find(folder, &named, &asked)?;
    fs::create_dir_all(&args.out).map_err(|fault| CliError::unwritable(&args.out, &fault))?;
    if let Some(document) = &args.table {
        // Checked hours before the tables exist.
        place(document, "")?;
    }
    let cancel = CancelFlag::default();
    cancel_on_interrupt(cancel.clone());
    let mut suite = Suite {
        runner: wiring::runner(
            &adapter.adapter,
            MemoryFlags::default().limits(1),
            std::env::temp_dir(),
            wiring::lpips(lpips.lpips.as_deref())?,
        ),
        adapter,
        external_formats: args.external_formats.as_deref(),
        records: JsonLines::open(&args.out.join("runs.jsonl"))?,
        entries,
        cancel,
        failed: Vec::new(),
    };
    let steps: BTreeMap<&str, u32> = args.steps.iter().map(|(set, steps)| (set.as_str(), *steps)).collect();
    let mut results: Vec<Record> = Vec::new();
    for (name, path) in &sets {
        let iterations = steps.get(name.as_str()).copied().or(shared.iterations);
        let set = Set {
            name,
            path,
            dataset: wiring::load_dataset(path)?,
            options: TrainOptions { iterations, ..shared.clone() },
        };
        let equal = suite.equal_steps(&set)?;
        if !args.steps_only {
            results.extend(suite.equal_seconds(&set, &equal)?);
        }
        results.extend(equal);
        publish(args, &results)?;
    }
    let text = publish(args, &results)?;
    match suite.failed.first() {
        None => Ok(Report::new(text, &json!({ "runs": results }))),
        Some(first) => {
            let detail = format!("{} of the runs failed; the first: {first}", suite.failed.len());
            Err(Problem::new(ProblemType::SuiteIncomplete, detail).into())
        }
    }
}

/// Writes the results so far and returns the tables.
fn publish(args: &Args, results: &[Record]) -> Result<String, CliError> {
    let text = table::markdown(&results.iter().collect::<Vec<_>>());
    let json = serde_json::to_vec_pretty(&json!({ "runs": results }))
        .map_err(|fault| CliError::unwritable(&args.out, &fault.into()))?;
    files::write(&args.out.join("results.json"), &json)?;
    files::write(&args.out.join("results.md"), text.as_bytes())?;
    if let Some(document) = &args.table {
        files::write(document, place(document, &text)?.as_bytes())?;
    }
    Ok(text)
}

/// The document with the tables in their place.
fn place(document: &Path, tables: &str) -> Result<String, CliError> {
    let text = fs::read_to_string(document).map_err(|fault| CliError::unreadable(document, &fault))?;
    table::rewrite(&text, tables).map_err(|fault| {
        Problem::new(ProblemType::NoPlace, fault).in_file(document.display().to_string()).into()
    })
}

/// A set in memory, with the options of its equal steps.
struct Set<'a> {
    name: &'a str,
    path: &'a Path,
    dataset: Dataset,
    options: TrainOptions,
}

struct Suite<'a> {
    runner: Pipeline,
    adapter: &'a AdapterFlag,
    /// The script of `--external-formats`.
    external_formats: Option<&'a Path>,
    records: JsonLines<Record>,
    entries: Vec<Entry>,
    cancel: CancelFlag,
    failed: Vec<Problem>,
}

impl Suite<'_> {
    /// The successful runs of all entries with the set's iterations.
    fn equal_steps(&mut self, set: &Set<'_>) -> Result<Vec<Record>, CliError> {
        let mut done = Vec::new();
        for entry in self.entries.clone() {
            if entry.duplicate_of(&set.options).is_some_and(|plainer| self.entries.contains(&plainer)) {
                continue;
            }
            let options = entry.options(&set.options).validated()?;
            let kept = self.kept(set, &entry, &options, Comparison::Steps);
            let wants_external_formats = self.wants_external_formats(&options);
            let is_it = |record: &Record| {
                record.options == options && !(wants_external_formats && record.external_formats.is_empty())
            };
            match kept.into_iter().find(is_it) {
                Some(record) => done.push(record),
                None => done.extend(self.train(set, &entry, options, Comparison::Steps, None)?),
            }
        }
        Ok(done)
    }

    /// The run of every model that best fills the seconds of the slowest.
    fn equal_seconds(&mut self, set: &Set<'_>, equal: &[Record]) -> Result<Vec<Record>, CliError> {
        let whole: Vec<Entry> = self.entries.iter().filter(|entry| entry.is_whole()).cloned().collect();
        let of = |entry: &Entry| equal.iter().find(|record| record.entry == entry.to_string());
        let budget =
            whole.iter().filter_map(of).map(|record| record.metrics.seconds.train).fold(0.0, f64::max);
        let mut done = Vec::new();
        for entry in &whole {
            let Some(first) = of(entry) else { continue };
            let first = Record { comparison: Comparison::Seconds, budget: Some(budget), ..first.clone() };
            let kept = self.kept(set, entry, &entry.options(&set.options), Comparison::Seconds);
            let mut runs = vec![first];
            runs.extend(kept.into_iter().filter(|record| record.budget == Some(budget)));
            let taken = |runs: &[Record]| -> Vec<seconds::Run> {
                runs.iter().map(|run| (run.metrics.steps, run.metrics.seconds.train)).collect()
            };
            while runs.len() <= MAX_TRIES
                && let Some(steps) = seconds::next_steps(&taken(&runs), budget)
            {
                let iterations = u32::try_from(steps).ok();
                let options = TrainOptions { iterations, ..entry.options(&set.options) };
                match self.train(set, entry, options, Comparison::Seconds, Some(budget))? {
                    Some(record) => runs.push(record),
                    None => break,
                }
            }
            if let Some(best) = seconds::nearest(&taken(&runs), budget) {
                done.push(runs.swap_remove(best));
            }
        }
        Ok(done)
    }

    fn kept(
        &self,
        set: &Set<'_>,
        entry: &Entry,
        options: &TrainOptions,
        comparison: Comparison,
    ) -> Vec<Record> {
        let name = entry.to_string();
        let wanted = Wanted { set: set.name, dataset: set.dataset.digest, entry: &name, options };
        let is_it = |record: &&Record| record.comparison == comparison && record.is_like(&wanted);
        self.records.all().iter().filter(is_it).cloned().collect()
    }

    /// Trains, measures and records one run; `None` if it failed, and the suite continues.
    fn train(
        &mut self,
        set: &Set<'_>,
        entry: &Entry,
        options: TrainOptions,
        comparison: Comparison,
        budget: Option<f64>,
    ) -> Result<Option<Record>, CliError> {
        eprintln!("tcgs: {} {entry}{}", set.name, budget.map_or_else(String::new, |s| format!(", {s:.1} s")));
        let mut display = Display::new();
        let mut show = |phase: Phase, progress: &_| display.show(phase, progress);
        let outcome = self.runner.run(set.path, &options, &Checkpoints::default(), &mut show, &self.cancel);
        display.finish();
        let output = match outcome {
            Ok(output) => output,
            Err(JobError::Cancelled) => return Err(CliError::Stopped),
            Err(JobError::Fail(problem) | JobError::Retry(problem) | JobError::Hold(problem)) => {
                eprintln!("tcgs: {} {entry} failed: {problem}", set.name);
                self.failed.push(problem.in_file(format!("{} {entry}", set.name)));
                return Ok(None);
            }
        };
        let external_formats = match comparison {
            Comparison::Steps if self.wants_external_formats(&options) => {
                let renderer = |file| wiring::Renderer::open(file, &self.adapter.adapter);
                external_formats::measure(self.external_formats, &output, &set.dataset, &renderer)?
            }
            _ => Vec::new(),
        };
        let record = Record {
            set: set.name.to_owned(),
            dataset: set.dataset.digest,
            comparison,
            entry: entry.to_string(),
            budget,
            options,
            high_band: self.high_band(set, &output)?,
            metrics: output.metrics,
            external_formats,
        };
        Ok(Some(self.records.add(&record)?))
    }

    fn wants_external_formats(&self, options: &TrainOptions) -> bool {
        self.external_formats.is_some() && options.model == ModelKind::Gaussians3d
    }

    fn high_band(&self, set: &Set<'_>, output: &JobOutput) -> Result<Option<f64>, CliError> {
        let renderer = wiring::Renderer::open(wiring::read(&output.file)?, &self.adapter.adapter)?;
        Ok(wiring::high_band_error(&renderer, &set.dataset, output.metrics.background)?)
    }
}
