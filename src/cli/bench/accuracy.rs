//! `tcgs bench accuracy`: the kernels' errors on hard cases.

use serde::Serialize;
use tcgs::{
    domain::{Problem, ProblemType},
    gpu::Device,
};

use tcgs_lab::accuracy::{self, Outcome};

use crate::cli::{CliError, Report, adapter::AdapterFlag};

/// Arguments of `tcgs bench accuracy`.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// Print one JSON document
    #[arg(long)]
    pub(super) json: bool,

    #[command(flatten)]
    adapter: AdapterFlag,
}

#[derive(Debug, Serialize)]
struct Accuracy {
    /// Adapter, driver and backend.
    adapter: String,
    cases: Vec<Outcome>,
}

/// Measures every case; fails with status 1 and the same report unless every bound held.
pub(crate) fn run(args: &Args) -> Result<Report, CliError> {
    let device = Device::new(&args.adapter.adapter).map_err(Problem::from)?;
    let cases =
        accuracy::measure(&device, |case| tracing::info!(case, "measuring")).map_err(Problem::from)?;
    let accuracy = Accuracy { adapter: device.adapter_line(), cases };
    conclude(&accuracy)
}

fn conclude(accuracy: &Accuracy) -> Result<Report, CliError> {
    let report = Report::new(text(accuracy), accuracy);
    let exceeded = accuracy.cases.iter().filter(|outcome| !outcome.held);
    let exceeded: Vec<String> = exceeded.map(|o| format!("{} ({})", o.name, o.quantity)).collect();
    if exceeded.is_empty() {
        return Ok(report);
    }
    let detail = format!(
        "{} of {} errors are beyond their bounds on {}: {}; update the driver, or report them",
        exceeded.len(),
        accuracy.cases.len(),
        accuracy.adapter,
        exceeded.join(", ")
    );
    let problem = Problem::new(ProblemType::AccuracyBoundsExceeded, detail);
    Err(CliError::Reported { problem: Box::new(problem), text: report.text, json: report.json })
}

fn text(accuracy: &Accuracy) -> String {
    let longest = |of: fn(&Outcome) -> usize| accuracy.cases.iter().map(of).max().unwrap_or(0);
    let (names, quantities) = (longest(|o| o.name.len()), longest(|o| o.quantity.len()));
    let mut lines = vec![accuracy.adapter.clone(), String::new()];
    lines.push(format!("{:names$}  {:quantities$}  {:>8}  {:>8}", "case", "quantity", "error", "bound"));
    for o in &accuracy.cases {
        let mark = if o.held { "" } else { "  EXCEEDED" };
        lines.push(format!(
            "{:names$}  {:quantities$}  {:>8.1e}  {:>8.1e}{mark}",
            o.name, o.quantity, o.error, o.bound
        ));
    }
    let held = accuracy.cases.iter().filter(|outcome| outcome.held).count();
    lines.push(format!("\n{held} of {} errors are within their bounds", accuracy.cases.len()));
    lines.join("\n")
}

#[cfg(test)]
mod tests {
    use super::*;

    fn outcome(error: f64) -> Outcome {
        Outcome { name: "needles", quantity: "image", error, bound: 1e-4, held: error <= 1e-4 }
    }

    #[test]
    fn a_bound_that_is_not_held_is_in_the_report_and_in_the_exit_status() {
        let held = Accuracy { adapter: "one".to_owned(), cases: vec![outcome(0.0)] };
        assert!(conclude(&held).is_ok());
        let cases = vec![outcome(0.0), outcome(f64::NAN)];
        let failure = conclude(&Accuracy { cases, ..held }).expect_err("not held");
        assert_eq!(failure.exit_status(), 1);
        assert!(failure.to_string().contains("1 of 2"), "{failure}");
        let CliError::Reported { problem, text, json } = &failure else { panic!("{failure:?}") };
        assert!(problem.is(ProblemType::AccuracyBoundsExceeded));
        assert_eq!(json["cases"][1]["held"], false);
        assert!(json["cases"][1]["error"].is_null());
        assert!(text.contains("EXCEEDED"), "{text}");
    }
}
