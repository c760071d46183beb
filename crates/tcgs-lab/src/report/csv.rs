//! Two tables of comma-separated values: every run with everything, and the columns of the 3DGS.zip survey.

use std::fmt::Write as _;

use tcgs_codec::domain::{csv_cell as cell, metrics_columns};

use super::{
    record::RunRecord,
    summary::{Group, LEVELS},
    sweep::SweepRecord,
    worst_views::worst_tenth,
};

/// The header of the survey's files.
const SURVEY: &str = "Submethod,PSNR,SSIM,LPIPS,Size [Bytes],#Gaussians";

fn optional(value: Option<f64>) -> String {
    value.map_or_else(String::new, |value| value.to_string())
}

/// A line for each run.
pub fn runs(records: &[RunRecord]) -> String {
    let mut text = String::new();
    for run in records {
        let columns = columns(run);
        if text.is_empty() {
            let names: Vec<&str> = columns.iter().map(|(name, _)| name.as_str()).collect();
            text = names.join(",") + "\n";
        }
        let cells: Vec<String> = columns.iter().map(|(_, value)| cell(value)).collect();
        text.push_str(&(cells.join(",") + "\n"));
    }
    text
}

/// The columns of a run: what it is, the machine, its metrics, and what the report measured beside them.
fn columns(run: &RunRecord) -> Vec<(String, String)> {
    let [before, after] = &run.machine;
    let own = [
        ("set", run.set.clone()),
        ("dataset_sha256", run.dataset.to_string()),
        ("model", run.model.clone()),
        ("lambda", optional(run.options.lambda)),
        ("preset", run.options.preset.to_string()),
        ("seed", run.options.seed.to_string()),
        ("session", run.session.clone()),
        ("cores", after.cores.to_string()),
        ("load_before", optional(before.load)),
        ("load_after", optional(after.load)),
        ("least_decode_seconds", run.least_decode_seconds().to_string()),
        ("ms_per_view", optional(run.render_seconds.map(|seconds| 1e3 * seconds))),
        ("high_band_error", optional(run.high_band)),
        ("worst_tenth_psnr", optional(worst_tenth(&run.metrics.test))),
    ];
    let levels = LEVELS.map(|level| (format!("seconds_to_{level}_db"), optional(run.seconds_to(level))));
    let metrics = metrics_columns(&run.metrics).into_iter().map(|(name, value)| (name.to_owned(), value));
    own.into_iter().map(|(name, value)| (name.to_owned(), value)).chain(metrics).chain(levels).collect()
}

/// A line for each made scene, size and variant.
pub fn renders(sweeps: &[SweepRecord]) -> String {
    let mut text = "gaussians,side,adapter,variant,ms_least,ms_median,rmse,max_error,cutoff_rmse,reference_seconds,cores,load_before,\
        load_after\n"
        .to_owned();
    for sweep in sweeps {
        for variant in &sweep.variants {
            let [before, after] = &sweep.machine;
            let mut times = variant.milliseconds.clone();
            times.sort_by(f64::total_cmp);
            let median = times.get(times.len() / 2).copied();
            let cells = [
                sweep.gaussians.to_string(),
                sweep.side.to_string(),
                cell(&sweep.adapter[1]),
                cell(&variant.name),
                optional(times.first().copied()),
                optional(median),
                variant.error.rmse.to_string(),
                variant.error.max.to_string(),
                sweep.cutoff_rmse.to_string(),
                sweep.reference_seconds.to_string(),
                after.cores.to_string(),
                optional(before.load),
                optional(after.load),
            ];
            let _ = writeln!(text, "{}", cells.join(","));
        }
    }
    text
}

/// The survey's table for one set: a line for each group, with the means over its seeds, and one for each format that its scenes were
/// converted to.
pub fn survey(groups: &[Group<'_>], set: &str) -> String {
    let mut text = SURVEY.to_owned() + "\n";
    for group in groups.iter().filter(|group| group.set() == set) {
        let mean = |figure: &dyn Fn(&RunRecord) -> Option<f64>| group.estimate(figure).map(|it| it.mean);
        let name = format!("{}-{}", group.name(), group.first().metrics.steps);
        let mut line = |name: &str, figures: [Option<f64>; 5]| {
            let digits = [2, 4, 4, 0, 0];
            let cells = figures.iter().zip(digits).map(|(figure, digits)| {
                figure.map_or_else(String::new, |figure| format!("{figure:.digits$}"))
            });
            let cells: Vec<String> = cells.collect();
            let _ = writeln!(text, "{},{}", cell(name), cells.join(","));
        };
        let gaussians = mean(&|run| Some(run.metrics.gaussians as f64));
        line(
            &name,
            [
                mean(&|run| run.metrics.test.psnr),
                mean(&|run| run.metrics.test.ssim),
                mean(&|run| run.metrics.test.lpips),
                mean(&|run| Some(run.metrics.bytes.total as f64)),
                gaussians,
            ],
        );
        for file in &group.first().external_formats {
            let of = |run: &RunRecord| {
                run.external_formats.iter().find(|other| other.format == file.format).cloned()
            };
            line(
                &format!("{name}-{}", file.format),
                [
                    mean(&|run| of(run)?.psnr),
                    mean(&|run| of(run)?.ssim),
                    None,
                    mean(&|run| Some(of(run)?.bytes as f64)),
                    gaussians,
                ],
            );
        }
    }
    text
}

#[cfg(test)]
mod tests {
    use tcgs_codec::domain::ModelKind;

    use super::*;
    use crate::report::{record::ExternalFile, summary::tests::record};

    #[test]
    fn every_run_has_as_many_cells_as_the_header() {
        let mut run = record(ModelKind::Tcgs, Some(0.002), 1, 30.25, 1234);
        run.metrics.adapter = "an adapter, with \"quotes\"".to_owned();
        let text = runs(&[run]);
        let mut lines = text.lines();
        let header = lines.next().expect("a header");
        let row = lines.next().expect("a row");
        assert!(row.contains("\"an adapter, with \"\"quotes\"\"\""), "{row}");
        assert_eq!(row.matches(',').count(), header.matches(',').count() + 1, "{row}");
        let at = |name: &str| header.split(',').position(|column| column == name).expect(name);
        // The adapter's comma is before these columns.
        let cells: Vec<&str> = row.split(',').collect();
        assert_eq!((cells[at("psnr") + 1], cells[at("bytes") + 1]), ("30.25", "1234"), "{row}");
    }

    #[test]
    fn the_surveys_table_has_means_over_seeds_and_formats() {
        let mut records: Vec<RunRecord> = [30.0, 31.0]
            .into_iter()
            .zip(0..)
            .map(|(psnr, seed)| record(ModelKind::Gaussians3d, None, seed, psnr, 1000))
            .collect();
        for run in &mut records {
            run.external_formats = vec![ExternalFile {
                format: "sog".to_owned(),
                bytes: 100,
                psnr: Some(29.5),
                ssim: Some(0.8),
            }];
        }
        let groups = Group::all(&records);
        assert_eq!(
            survey(&groups, "ball"),
            "Submethod,PSNR,SSIM,LPIPS,Size [Bytes],#Gaussians\n\
             3dgs-100,30.50,0.9000,,1000,50\n\
             3dgs-100-sog,29.50,0.8000,,100,50\n"
        );
        assert_eq!(survey(&groups, "box").lines().count(), 1);
    }
}
