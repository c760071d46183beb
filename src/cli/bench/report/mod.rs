//! `tcgs bench report`: a declared matrix of runs, and tables and charts of speed against error from their records.
//!
//! A record is kept as soon as its run is finished, and a report that is started again makes only what is missing. Tables and charts are
//! written anew after every run, so they can be read while the report goes on.

mod external_formats;
mod runner;
mod sets;
mod sweep;

use std::{
    collections::{BTreeMap, BTreeSet},
    fs,
    path::{Path, PathBuf},
};

use serde_json::json;
use tcgs::{
    domain::{Clock as _, Problem, ProblemType, SystemClock},
    pipeline::ReferenceViews,
};

use tcgs_lab::report::{
    content::ReportContent,
    csv, markdown,
    matrix::Matrix,
    page, plots, published,
    record::RunRecord,
    summary::{Curve, Group},
    sweep::SweepRecord,
};

use self::runner::{FailedRun, Runner, SuiteSet};
use crate::cli::{
    CliError, Report, adapter::AdapterFlag, files, json_lines::JsonLines, lpips::LpipsFlag, reading::LENIENT,
    signals::Interruption, wiring,
};

/// How an interrupted report goes on.
const ADVICE: &str = "finished runs are kept: the same command goes on with the others";

/// Arguments of `tcgs bench report`.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// Folder of datasets
    #[arg(long, value_name = "DIR")]
    suite: PathBuf,

    /// The matrix of runs
    #[arg(long, value_name = "FILE.toml", default_value = "benches/report.toml")]
    matrix: PathBuf,

    /// Folder of the report: report.html, report.md, runs.csv, survey-SET.csv, plots as .svg, and runs.jsonl, from which an interrupted
    /// report continues
    #[arg(short, long, value_name = "DIR", default_value = "out/report")]
    output: PathBuf,

    /// Document to update: the tables replace what is between its lines <!-- report: begin --> and <!-- report: end -->
    #[arg(long, value_name = "FILE.md")]
    table: Option<PathBuf>,

    /// Picture to write: PSNR against size of every set
    #[arg(long, value_name = "FILE.svg")]
    figure: Option<PathBuf>,

    /// The runs.jsonl of other reports; runs found there are not made again
    #[arg(long, value_name = "FILE.jsonl", value_delimiter = ',')]
    import: Vec<PathBuf>,

    /// Make no run; write the report of those that are there
    #[arg(long)]
    no_runs: bool,

    #[command(flatten)]
    lpips: LpipsFlag,

    #[command(flatten)]
    adapter: AdapterFlag,

    /// Print one JSON document
    #[arg(long)]
    pub(in crate::cli) json: bool,
}

/// Makes the runs that are missing and writes the report.
pub(crate) fn run(args: &Args) -> Result<Report, CliError> {
    let text =
        fs::read_to_string(&args.matrix).map_err(|error| CliError::unreadable(&args.matrix, &error))?;
    let in_matrix = |error: String| CliError::Usage(format!("{}: {error}", args.matrix.display()));
    let matrix = Matrix::parse(&text).map_err(in_matrix)?;
    published::check(&matrix.published).map_err(in_matrix)?;
    let named = matrix.named_sets();
    let only: &[&str] = if matrix.takes_all_sets() { &[] } else { &named };
    let found = sets::find(&args.suite, only, &named)?;
    let names: Vec<String> = found.iter().map(|(name, _)| name.clone()).collect();
    let plan = matrix.plan(&names).map_err(CliError::Usage)?;
    files::check_writable(&args.output.join("report.html"))?;
    if let Some(document) = &args.table {
        // Checked hours before the tables exist.
        place(document, "")?;
    }
    let records = JsonLines::open(&args.output.join("runs.jsonl"))?;
    let mut imported = Vec::new();
    for path in &args.import {
        imported.extend(JsonLines::<RunRecord>::read(path)?);
    }
    let used: BTreeSet<&str> = plan.iter().map(|run| run.set.as_str()).collect();
    let mut sets = BTreeMap::new();
    for (name, path) in found.into_iter().filter(|(name, _)| used.contains(name.as_str())) {
        // Names and contents decide whether a kept run is of this set; pixels are read again by each run.
        let digest = wiring::load_as(&path, &LENIENT)?.digest;
        sets.insert(name, SuiteSet { path, digest });
    }
    let interruption = Interruption::listen();
    let mut renders = JsonLines::open(&args.output.join("renders.jsonl"))?;
    let folder = args.matrix.parent().unwrap_or(Path::new("."));
    let external_formats = matrix.external_formats.as_ref().map(|script| folder.join(script));
    if let Some(script) = &external_formats {
        external_formats::check(script)?;
    }
    let mut runner = Runner {
        adapter: args.adapter.adapter.clone(),
        lpips: args.lpips.lpips.clone(),
        sets,
        records,
        imported,
        external_formats,
        export_formats: matrix.export_formats.iter().map(|format| format.0).collect(),
        reference: ReferenceViews { views: matrix.reference_views, max_side: matrix.reference_side.max(1) },
        session: SystemClock.now().to_string(),
        interruption: interruption.clone(),
    };
    let sweeps = match &matrix.render {
        None => Vec::new(),
        Some(sweep) if args.no_runs => sweep::kept(sweep, &renders),
        Some(sweep) => sweep::make(sweep, &args.adapter.adapter, &mut renders, &interruption)?,
    };
    let document = Document { args, matrix: &matrix, wanted: plan.len(), sweeps: &sweeps };
    let mut publish = |done: &[RunRecord]| document.publish(done, &[]);
    let (done, failed) = match args.no_runs {
        true => (runner.all_kept(&plan), Vec::new()),
        false => runner.make(&plan, &mut publish)?,
    };
    document.publish(&done, &failed)?;
    if let Some(first) = failed.first() {
        let detail =
            format!("{} of the runs failed; the first: {}: {}", failed.len(), first.run, first.problem);
        return Err(Problem::new(ProblemType::SuiteIncomplete, detail).into());
    }
    let text =
        format!("{} of {} runs\nwrote {}", done.len(), plan.len(), args.output.join("report.html").display());
    Ok(Report::new(
        text,
        &json!({ "runs": done, "wanted": plan.len(), "report": args.output.join("report.html") }),
    ))
}

/// What is written anew after every run.
struct Document<'a> {
    args: &'a Args,
    matrix: &'a Matrix,
    /// Runs of the matrix.
    wanted: usize,
    sweeps: &'a [SweepRecord],
}

impl Document<'_> {
    /// Writes every table and chart of the runs so far.
    fn publish(&self, records: &[RunRecord], failed: &[FailedRun]) -> Result<(), CliError> {
        let groups = Group::all(records);
        let sets: BTreeSet<&str> = records.iter().map(|run| run.set.as_str()).collect();
        let sets: Vec<&str> = sets.into_iter().collect();
        let plots = plots::all(&groups, &sets, self.sweeps);
        let curves = Curve::all(&groups);
        let content = ReportContent {
            records,
            groups: &groups,
            plots: &plots,
            sweeps: self.sweeps,
            differences: &Curve::differences(&curves),
            comparisons: &published::comparisons(&self.matrix.published, &groups),
            failed: failed.iter().map(|failed| format!("{}: {}", failed.run, failed.problem)).collect(),
            wanted: self.wanted,
        };
        let (introduction, sections) = (content.introduction(), content.sections());
        let tables = markdown::text(&introduction, &sections);
        let write = |name: &str, text: String| files::write(&self.args.output.join(name), text.as_bytes());
        write("report.html", page::html(&introduction, &sections))?;
        if let Some(document) = &self.args.table {
            files::write(document, place(document, &tables)?.as_bytes())?;
        }
        if let (Some(file), Some(picture)) = (&self.args.figure, plots.quality()) {
            files::write(file, picture.as_bytes())?;
        }
        write("report.md", tables)?;
        write("runs.csv", csv::runs(records))?;
        write("renders.csv", csv::renders(self.sweeps))?;
        for set in sets {
            write(&format!("survey-{set}.csv"), csv::survey(&groups, set))?;
        }
        for plot in plots.all() {
            if let Some(picture) = plot.chart.standalone() {
                write(&format!("{}.svg", plot.file), picture)?;
            }
        }
        Ok(())
    }
}

/// The document with the tables in their place.
fn place(document: &Path, tables: &str) -> Result<String, CliError> {
    let text = fs::read_to_string(document).map_err(|error| CliError::unreadable(document, &error))?;
    markdown::rewrite(&text, tables).map_err(|error| {
        Problem::new(ProblemType::NoPlace, error).in_file(document.display().to_string()).into()
    })
}
