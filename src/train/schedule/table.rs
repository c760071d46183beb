//! The schedules of all presets as one Markdown table, made from the schedules themselves; `docs/SCHEDULE.md` holds it.

use std::fmt::Write as _;

use super::{BaseStepRule, CompressionSchedule, Decay, Fall, PlainSchedule, Schedule};
use crate::{
    domain::{Preset, TrainOptions},
    train::WaveletWeights,
};

/// One preset's schedules: of anchors, and of plain Gaussians.
struct Column {
    anchors: Schedule,
    plain: PlainSchedule,
}

impl Column {
    fn of(preset: Preset) -> Self {
        let options = TrainOptions { preset, ..TrainOptions::default() };
        let anchors = Schedule::new(&options);
        Self { plain: PlainSchedule::new(&options, anchors.steps), anchors }
    }

    /// A step with its share of the run.
    fn at(&self, step: u32) -> String {
        let share = 100.0 * f64::from(step) / f64::from(self.anchors.steps);
        // Two digits, without the zeros that say nothing.
        format!("{step} ({} %)", (100.0 * share).round() / 100.0)
    }
}

/// The table.
#[must_use]
pub fn schedule_table() -> String {
    let columns: Vec<Column> = Preset::ALL.iter().map(|preset| Column::of(*preset)).collect();
    let mut text = String::from("| what |");
    for preset in Preset::ALL {
        let _ = write!(text, " `{preset}` |");
    }
    text.push_str("\n|---|");
    text.push_str(&"--:|".repeat(columns.len()));
    text.push('\n');
    let mut row = |what: &str, value: &dyn Fn(&Column) -> String| {
        let _ = write!(text, "| {what} |");
        for column in &columns {
            let _ = write!(text, " {} |", value(column));
        }
        text.push('\n');
    };
    row("steps", &|c| c.anchors.steps.to_string());
    row("random points, where a set has none", &|c| c.anchors.random_points.to_string());
    anchors(&mut row);
    masks(&mut row);
    compression(&mut row);
    wavelet(&mut row);
    plain(&mut row);
    text
}

type Row<'a> = dyn FnMut(&str, &dyn Fn(&Column) -> String) + 'a;

fn anchors(row: &mut Row<'_>) {
    row("**anchors** (`tcgs`, `scaffold`)", &|_| String::new());
    row("feature width, offsets an anchor", &|c| {
        format!("{}, {}", c.anchors.shape.features, c.anchors.shape.offsets)
    });
    row("anchors at most", &|c| c.anchors.max_anchors.to_string());
    row("views count for growth after", &|c| c.at(c.anchors.statistics_from));
    row("growth and pruning after", &|c| c.at(c.anchors.densify_from));
    row("growth and pruning before", &|c| c.at(c.anchors.densify_until));
    row("growth and pruning every", &|c| format!("{} steps", c.anchors.densify_every));
    row("growth from a screen gradient of", &|c| c.anchors.growth_threshold.to_string());
    row("rate of offsets, times the extent", &|c| rate(c.anchors.offset));
    row("rate of features", &|c| rate(c.anchors.feature));
    row("rate of log-scalings", &|c| rate(c.anchors.scaling));
    row("rate of the opacity network", &|c| rate(c.anchors.networks[0]));
    row("rate of the covariance network", &|c| rate(c.anchors.networks[1]));
    row("rate of the colour network", &|c| rate(c.anchors.networks[2]));
    row("weight of the volume regulariser", &|c| c.anchors.volume_weight.to_string());
}

fn masks(row: &mut Row<'_>) {
    type Value = fn(&Column, &super::MaskSchedule) -> String;
    let rows: [(&str, Value); 6] = [
        ("masks learn from", |c, masks| c.at(masks.from)),
        ("their loss counts from", |c, masks| c.at(masks.loss_from)),
        ("masks learn until, then the rest settles", |c, masks| c.at(masks.until)),
        ("rate of mask logits", |_, masks| rate(masks.rate)),
        ("weight of the mask loss", |_, masks| format!("{:?}", masks.weight)),
        ("a logit makes Gaussians above", |_, masks| format!("{:.3}", masks.level)),
    ];
    row("**offset masks** (`tcgs`)", &|_| String::new());
    for (what, value) in rows {
        row(what, &|c| c.anchors.masks.as_ref().map_or_else(String::new, |masks| value(c, masks)));
    }
}

fn compression(row: &mut Row<'_>) {
    type Value = fn(&Column, &CompressionSchedule) -> String;
    let rows: [(&str, Value); 13] = [
        ("growth pauses from", |c, _| {
            c.anchors.densify_pause.as_ref().map_or_else(String::new, |p| c.at(p.start))
        }),
        ("growth goes on from", |c, _| {
            c.anchors.densify_pause.as_ref().map_or_else(String::new, |p| c.at(p.end))
        }),
        ("noise as wide as base steps from", |c, s| c.at(s.noise_from)),
        ("context model and rate from", |c, s| c.at(s.context_from)),
        ("planes are reconstructed from", |c, s| {
            if s.compresses_planes {
                c.at(s.reconstruct_from)
            } else {
                "never, stored as they are".to_owned()
            }
        }),
        ("all is rounded as in the file from", |c, s| c.at(s.rounded_from)),
        ("base steps of features, scalings, offsets", |_, s| match s.base {
            BaseStepRule::Published => "1, 0.001 world units, 0.2".to_owned(),
            BaseStepRule::Relative { feature, scaling, offset, .. } => {
                format!("{feature}, {scaling} of the median, {offset}")
            }
        }),
        ("the first noise is finer by", |_, s| format!("{} octaves", s.base.finer())),
        ("weight of the rate (lambda)", |_, s| s.lambda.to_string()),
        ("share of the anchors in a step's sample", |_, s| s.sampled.to_string()),
        ("rate of planes and their layers, over the context model's steps", |_, s| rate(s.planes)),
        ("rate of the context networks, over the same", |_, s| rate(s.networks)),
        ("weight of the planes' reconstruction", |_, s| {
            if s.compresses_planes { s.reconstruction.to_string() } else { "–".to_owned() }
        }),
    ];
    row("**compression** (`tcgs`)", &|_| String::new());
    for (what, value) in rows {
        row(what, &|c| c.anchors.compression.as_ref().map_or_else(String::new, |s| value(c, s)));
    }
}

fn wavelet(row: &mut Row<'_>) {
    row("**wavelet constraint** (`tcgs`): low; fine high; coarse high", &|_| String::new());
    for fraction in [0.0, 0.5, 5.0 / 6.0, 1.0] {
        let WaveletWeights { low, fine, coarse } = WaveletWeights::at(fraction);
        let mean = |bands: [f64; 3]| bands.iter().sum::<f64>() / 3.0;
        let (fine, coarse) = (mean(fine), mean(coarse));
        row(&format!("weights at {:.1} % of the run", 100.0 * fraction), &|_| {
            format!("{low:.5}; {fine:.5}; {coarse:.5}")
        });
    }
}

fn plain(row: &mut Row<'_>) {
    row("**plain Gaussians** (`3dgs`)", &|_| String::new());
    row("Gaussians at most", &|c| c.plain.max_gaussians.to_string());
    row("growth and pruning after", &|c| c.at(c.plain.densify_from));
    row("growth and pruning before", &|c| c.at(c.plain.densify_until));
    row("growth and pruning every", &|c| format!("{} steps", c.plain.densify_every));
    row("growth from a screen gradient of", &|c| c.plain.growth_threshold.to_string());
    row("opacities are reset every", &|c| c.at(c.plain.reset_every));
    row("a degree of spherical harmonics more every", &|c| c.at(c.plain.degree_every));
    row("rate of means, times the extent", &|c| rate(c.plain.mean));
    row("rate of the constant colour", &|c| format!("{:.3e}", c.plain.color));
    row("rate of the other coefficients", &|c| format!("{:.3e}", c.plain.coefficients));
    row("rate of opacity logits", &|c| c.plain.opacity.to_string());
    row("rate of log-scales", &|c| format!("{:.3e}", c.plain.log_scale));
    row("rate of quaternions", &|c| format!("{:.3e}", c.plain.quat));
}

fn rate(decay: Decay) -> String {
    let Decay { start, end, fall } = decay;
    match fall {
        _ if start == end => format!("{start:?}"),
        Fall::Exponential => format!("{start:.3e} → {end:.3e}"),
        Fall::Quadratic => format!("{start:.3e} ↘ {end:.3e}"),
    }
}

#[cfg(test)]
mod tests {
    use std::{fs, path::Path};

    use super::*;

    const BEGIN: &str = "<!-- schedule: begin -->\n";
    const END: &str = "<!-- schedule: end -->\n";

    /// With `TCGS_WRITE_DOCS=1` the page is rewritten instead.
    #[test]
    fn the_page_holds_the_table_of_these_schedules() {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("docs/SCHEDULE.md");
        let page = fs::read_to_string(&path).expect("docs/SCHEDULE.md");
        let (before, rest) = page.split_once(BEGIN).expect("where the table begins");
        let (found, after) = rest.split_once(END).expect("where the table ends");
        let table = format!("\n{}\n", schedule_table());
        if std::env::var("TCGS_WRITE_DOCS").is_ok_and(|value| value == "1") {
            fs::write(&path, format!("{before}{BEGIN}{table}{END}{after}")).expect("written");
        } else {
            assert_eq!(found, table, "run this test with TCGS_WRITE_DOCS=1 to bring the page up to the code");
        }
    }
}
