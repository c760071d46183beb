//! The tables of sizes: bytes by section, what each part of the method saves, and quality against bytes with the baselines and other
//! programs' formats.

use std::fmt::Write as _;

use tcgs::domain::{ByteCounts, ModelKind};

use super::record::{Comparison, Record};

/// Both tables, from the runs at equal steps; nothing if no run has a `.tcgs` file.
pub(super) fn markdown(text: &mut String, records: &[&Record]) {
    let runs: Vec<&Record> =
        records.iter().copied().filter(|record| record.comparison == Comparison::Steps).collect();
    if runs.iter().any(|run| is_coded(run)) {
        bytes(text, &runs);
        curve(text, &runs);
    }
}

/// Whether its file is a `.tcgs` file.
fn is_coded(record: &Record) -> bool {
    record.options.model == ModelKind::Tcgs
}

fn bytes(text: &mut String, runs: &[&Record]) {
    let names = ByteCounts::default().parts().map(|(name, _)| name);
    let _ = writeln!(text, "### Bytes by section, and what each part of the method is worth\n");
    let _ = writeln!(
        text,
        "| set | entry | {} | total | PSNR dB | SSIM | / ideal | / floats | 3dgs / it | scaffold / it | ΔPSNR to scaffold | ΔPSNR to tcgs |",
        names.join(" | ")
    );
    let _ = writeln!(text, "|---|---|{}--:|--:|--:|--:|--:|--:|--:|--:|--:|", "--:|".repeat(names.len()));
    for run in runs {
        let counts = &run.metrics.bytes;
        let parts = match is_coded(run) {
            true => counts.parts().map(|(_, bytes)| bytes.to_string()).join(" | "),
            false => names.map(|_| "–").join(" | "),
        };
        let of = |entry: &str| runs.iter().find(|other| other.set == run.set && other.entry == entry);
        let ratio = |entry: &str| match of(entry) {
            Some(other) if is_coded(run) => {
                format!("{:.1}", other.metrics.bytes.total as f64 / counts.total.max(1) as f64)
            }
            _ => "–".to_owned(),
        };
        let gain = |entry: &str| match (
            of(entry).and_then(|other| other.metrics.test.psnr),
            run.metrics.test.psnr,
        ) {
            (Some(theirs), Some(ours)) if is_coded(run) => format!("{:+.2}", ours - theirs),
            _ => "–".to_owned(),
        };
        let _ = writeln!(
            text,
            "| {} | {} | {parts} | {} | {} | {} | {} | {} | {} | {} | {} | {} |",
            run.set,
            run.entry,
            counts.total,
            figure(run.metrics.test.psnr, 2),
            figure(run.metrics.test.ssim, 4),
            figure(run.metrics.coding.map(|coding| coding.entropy_overhead), 4),
            figure(run.metrics.coding.and_then(|coding| coding.over_floats), 4),
            ratio("3dgs"),
            ratio("scaffold"),
            gain("scaffold"),
            gain("tcgs"),
        );
    }
    text.push('\n');
}

/// Files of every model and format, smallest first within a set.
fn curve(text: &mut String, runs: &[&Record]) {
    let _ = writeln!(text, "### Quality against bytes\n");
    text.push_str(
        "| set | file | bytes | PSNR dB | SSIM | tcgs at this PSNR, bytes |\n|---|---|--:|--:|--:|--:|\n",
    );
    let mut sets: Vec<&str> = runs.iter().map(|run| run.set.as_str()).collect();
    sets.dedup();
    for set in sets {
        let of_set: Vec<&&Record> = runs.iter().filter(|run| run.set == set).collect();
        let coded: Vec<(f64, u64)> = of_set
            .iter()
            .filter(|run| is_coded(run) && run.options.is_whole())
            .filter_map(|run| Some((run.metrics.test.psnr?, run.metrics.bytes.total)))
            .collect();
        let mut files = Vec::new();
        for run in of_set.iter().filter(|run| run.options.is_whole()) {
            let test = &run.metrics.test;
            let equal = if is_coded(run) { None } else { bytes_at(&coded, test.psnr) };
            files.push((run.metrics.bytes.total, run.entry.clone(), test.psnr, test.ssim, equal));
            for file in &run.external_formats {
                let name = format!("{} as {}", run.entry, file.format);
                files.push((file.bytes, name, file.psnr, file.ssim, bytes_at(&coded, file.psnr)));
            }
        }
        files.sort_by(|a, b| (a.0, &a.1).cmp(&(b.0, &b.1)));
        for (bytes, name, psnr, ssim, equal) in files {
            let equal = equal.map_or_else(|| "–".to_owned(), |bytes| format!("{bytes:.0}"));
            let _ = writeln!(
                text,
                "| {set} | {name} | {bytes} | {} | {} | {equal} |",
                figure(psnr, 2),
                figure(ssim, 4)
            );
        }
    }
    text.push('\n');
}

/// Bytes that the method needs for `psnr`, interpolated between its two nearest points: linear in dB over the logarithm of the bytes. A
/// point with a higher PSNR and fewer bytes is taken as it is; `None` beyond the best point.
fn bytes_at(points: &[(f64, u64)], psnr: Option<f64>) -> Option<f64> {
    let psnr = psnr?;
    let above = points.iter().filter(|point| point.0 >= psnr).min_by_key(|point| point.1)?;
    let below =
        points.iter().filter(|point| point.0 < psnr && point.1 < above.1).max_by(|a, b| a.0.total_cmp(&b.0));
    let Some(below) = below else { return Some(above.1 as f64) };
    let share = (psnr - below.0) / (above.0 - below.0);
    let (low, high) = ((below.1 as f64).ln(), (above.1 as f64).ln());
    Some((low + share * (high - low)).exp())
}

fn figure(value: Option<f64>, digits: usize) -> String {
    value.map_or_else(|| "–".to_owned(), |value| format!("{value:.digits$}"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bytes_at_a_psnr_lie_on_the_curve_or_at_its_cheapest_better_point() {
        let points = [(30.0, 100_000), (32.0, 400_000)];
        for (psnr, expected) in [(32.0, 400_000.0), (31.0, 200_000.0)] {
            let bytes = bytes_at(&points, Some(psnr)).expect("on the curve");
            assert!((bytes - expected).abs() < 1.0, "{psnr} dB: {bytes}");
        }
        assert_eq!(bytes_at(&points, Some(20.0)), Some(100_000.0));
        assert_eq!(bytes_at(&points, Some(33.0)), None);
        assert_eq!(bytes_at(&points, None), None);
        assert_eq!(bytes_at(&[(31.0, 50), (30.0, 80)], Some(30.5)), Some(50.0), "better and smaller");
    }
}
