//! The results as Markdown, and the place in a document where they go.

use std::fmt::Write as _;

use super::{
    codec_table,
    record::{Comparison, Record},
};

/// The markers around the part of a document that a suite rewrites.
const MARKERS: [&str; 2] = ["<!-- suite: begin -->", "<!-- suite: end -->"];

/// The tables of the records, one a comparison, in the order given.
pub(crate) fn markdown(records: &[&Record]) -> String {
    let mut text = String::new();
    for (comparison, title) in [(Comparison::Steps, "Equal steps"), (Comparison::Seconds, "Equal seconds")] {
        let rows: Vec<&&Record> = records.iter().filter(|record| record.comparison == comparison).collect();
        if rows.is_empty() {
            continue;
        }
        let _ = writeln!(text, "### {title}\n");
        text.push_str(
            "| set | model | steps | training s | of s | PSNR dB | SSIM | LPIPS | high-band error | anchors | Gaussians | bytes |\n\
             |---|---|--:|--:|--:|--:|--:|--:|--:|--:|--:|--:|\n",
        );
        for record in rows {
            row(&mut text, record);
        }
        text.push('\n');
    }
    codec_table::markdown(&mut text, records);
    conventions(&mut text, records);
    text
}

fn row(text: &mut String, record: &Record) {
    let metrics = &record.metrics;
    let figure = |value: Option<f64>, digits: usize| {
        value.map_or_else(|| "–".to_owned(), |value| format!("{value:.digits$}"))
    };
    let anchors = if metrics.anchors > 0 { metrics.anchors.to_string() } else { "–".to_owned() };
    let _ = writeln!(
        text,
        "| {} | {} | {} | {:.1} | {} | {} | {} | {} | {} | {anchors} | {} | {} |",
        record.set,
        record.entry,
        metrics.steps,
        metrics.seconds.train,
        figure(record.budget, 1),
        figure(metrics.test.psnr, 2),
        figure(metrics.test.ssim, 4),
        figure(metrics.test.lpips, 4),
        figure(record.high_band, 5),
        metrics.gaussians,
        metrics.bytes.total,
    );
}

/// Conventions and adapters of the figures, each sentence once.
fn conventions(text: &mut String, records: &[&Record]) {
    let mut lines: Vec<String> = Vec::new();
    for record in records {
        let metrics = &record.metrics;
        let options = &record.options;
        for line in [
            format!("Adapter: {}.", metrics.adapter),
            format!(
                "Preset {}, seed {}, on {}; tcgs {}.",
                options.preset,
                options.seed,
                options.background,
                env!("CARGO_PKG_VERSION")
            ),
            format!("Figures: {}.", metrics.conventions.to_string().trim().replace('\n', "; ")),
        ] {
            if !lines.contains(&line) {
                lines.push(line);
            }
        }
    }
    if !lines.is_empty() {
        lines.push(
            "Figures are of the written file's own scene on the held-out views. Bytes are those of the whole file: `.tcgs` for tcgs, \
             anchors and networks as floats for scaffold, a `.ply` of floats for 3dgs. The high-band error is the mean absolute \
             difference of the Haar coefficients of both levels' high bands."
                .to_owned(),
        );
    }
    for line in lines {
        let _ = writeln!(text, "- {line}");
    }
}

/// The document with `results` between its markers, or which marker is missing.
pub(crate) fn rewrite(document: &str, results: &str) -> Result<String, String> {
    let [begin, end] = MARKERS;
    let missing = |marker: &str| format!("the line '{marker}' is missing");
    let (before, rest) = document.split_once(begin).ok_or_else(|| missing(begin))?;
    let (_, after) = rest.split_once(end).ok_or_else(|| missing(end))?;
    Ok(format!("{before}{begin}\n\n{}\n\n{end}{after}", results.trim()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_around_the_markers_is_kept() {
        let document = "before\n<!-- suite: begin -->\nold\n<!-- suite: end -->\nafter\n";
        let once = rewrite(document, "new\n").expect("a place");
        assert_eq!(once, "before\n<!-- suite: begin -->\n\nnew\n\n<!-- suite: end -->\nafter\n");
        assert_eq!(rewrite(&once, "new"), Ok(once.clone()), "the same results change nothing");
        assert!(rewrite("no place", "new").expect_err("refused").contains("begin"));
        assert!(rewrite("<!-- suite: begin -->", "new").expect_err("refused").contains("end"));
    }

    #[test]
    fn no_record_makes_no_table() {
        assert_eq!(markdown(&[]), "");
    }
}
