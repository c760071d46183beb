//! The schedules of all presets as one Markdown table, made from the schedules themselves; `docs/SCHEDULE.md` holds it.

use std::fmt::Write as _;

use super::{BaseQuantStepRule, CompressionSchedule, Decay, DecayShape, MaskSchedule, Schedule};
use crate::{
    domain::{Preset, TrainOptions},
    train::WaveletWeights,
};

/// A step with its share of the run.
fn at(schedule: &Schedule, step: u32) -> String {
    let share = 100.0 * f64::from(step) / f64::from(schedule.steps);
    // At most two decimals, without trailing zeros.
    format!("{step} ({} %)", (100.0 * share).round() / 100.0)
}

/// The table.
#[must_use]
pub fn schedule_table() -> String {
    let schedule =
        |preset: &Preset| Schedule::new(&TrainOptions { preset: *preset, ..TrainOptions::default() });
    let columns: Vec<Schedule> = Preset::ALL.iter().map(schedule).collect();
    let mut text = String::from("| what |");
    for preset in Preset::ALL {
        let _ = write!(text, " `{preset}` |");
    }
    text.push_str("\n|---|");
    text.push_str(&"--:|".repeat(columns.len()));
    text.push('\n');
    let mut row = |what: &str, value: &dyn Fn(&Schedule) -> String| {
        let _ = write!(text, "| {what} |");
        for column in &columns {
            let _ = write!(text, " {} |", value(column));
        }
        text.push('\n');
    };
    row("steps", &|c| c.steps.to_string());
    row("random points, where a set has none", &|c| c.random_points.to_string());
    anchors(&mut row);
    masks(&mut row);
    compression(&mut row);
    wavelet(&mut row);
    plain(&mut row);
    text
}

type Row<'a> = dyn FnMut(&str, &dyn Fn(&Schedule) -> String) + 'a;

fn anchors(row: &mut Row<'_>) {
    row("**anchors** (`tcgs`, `scaffold`)", &|_| String::new());
    row("feature width, offsets per anchor", &|c| format!("{}, {}", c.shape.features, c.shape.offsets));
    row("networks see harmonics of the direction to degree (`scaffold`: 1)", &|c| {
        c.shape.view_degree.get().to_string()
    });
    row("features and networks begin with", &|c| match c.begins_colored {
        true => "the points' colors".to_owned(),
        false => "0, and random".to_owned(),
    });
    row("coarsest growth cell, in lattice cells", &|c| c.coarsest_growth.to_string());
    row("anchors at most", &|c| c.max_anchors.to_string());
    row("plain Gaussians until, where a set has no points", &|c| match c.plain_until {
        0 => "–".to_owned(),
        until => at(c, until),
    });
    row("then hidden units pass on deviations of a component", &|c| match c.plain_until {
        0 => "–".to_owned(),
        _ => c.passing_units.reach.to_string(),
    });
    row("views count for growth after", &|c| at(c, c.statistics_from));
    row("growth and pruning after", &|c| at(c, c.densify_from));
    row("growth and pruning before", &|c| at(c, c.densify_until));
    row("growth and pruning every", &|c| format!("{} steps", c.densify_every));
    row("growth from a screen gradient of (`scaffold`: 0.0002)", &|c| format!("{:.2e}", c.growth_threshold));
    row("learning rate of offsets, times the extent", &|c| learning_rate(c.offset));
    row("learning rate of features", &|c| learning_rate(c.feature));
    row("learning rate of log-scalings", &|c| learning_rate(c.scaling));
    row("learning rate of the opacity network", &|c| learning_rate(c.networks[0]));
    row("learning rate of the covariance network", &|c| learning_rate(c.networks[1]));
    row("learning rate of the color network", &|c| learning_rate(c.networks[2]));
    row("weight of the volume regularizer", &|c| c.volume_weight.to_string());
}

fn masks(row: &mut Row<'_>) {
    type Value = fn(&Schedule, &MaskSchedule) -> String;
    let rows: [(&str, Value); 6] = [
        ("masks learn from", |c, masks| at(c, masks.from)),
        ("their loss counts from", |c, masks| at(c, masks.loss_from)),
        ("masks learn until, then stay fixed", |c, masks| at(c, masks.until)),
        ("learning rate of mask logits", |_, masks| learning_rate(masks.learning_rate)),
        ("weight of the mask loss", |_, masks| format!("{:?}", masks.weight)),
        ("a logit makes Gaussians above", |_, masks| format!("{:.3}", masks.level)),
    ];
    row("**offset masks** (`tcgs`)", &|_| String::new());
    for (what, value) in rows {
        row(what, &|c| c.masks.as_ref().map_or_else(String::new, |masks| value(c, masks)));
    }
}

fn compression(row: &mut Row<'_>) {
    type Value = fn(&Schedule, &CompressionSchedule) -> String;
    let rows: [(&str, Value); 13] = [
        ("growth pauses from", |c, _| c.densify_pause.as_ref().map_or_else(String::new, |p| at(c, p.start))),
        ("growth continues from", |c, _| c.densify_pause.as_ref().map_or_else(String::new, |p| at(c, p.end))),
        ("noise as wide as the base quantization steps from", |c, s| at(c, s.noise_from)),
        ("context model and rate term from", |c, s| at(c, s.context_from)),
        ("planes are reconstructed from", |c, s| {
            if s.compresses_planes { at(c, s.reconstruct_from) } else { "never, stored directly".to_owned() }
        }),
        ("everything is rounded as in the file from", |c, s| at(c, s.rounded_from)),
        ("base quantization steps of features, scalings, offsets", |_, s| match s.base {
            BaseQuantStepRule::Published => "1, 0.001 world units, 0.2".to_owned(),
            BaseQuantStepRule::Relative { feature, scaling, offset, .. } => {
                format!("{feature}, {scaling} of the median, {offset}")
            }
        }),
        ("the first noise is finer by", |_, s| format!("{} octaves", s.base.finer_octaves())),
        ("weight of the rate term (lambda)", |_, s| s.lambda.to_string()),
        ("share of the anchors in a step's sample", |_, s| s.sample_share.to_string()),
        ("learning rate of planes and their layers, over the context model's steps", |_, s| {
            learning_rate(s.planes)
        }),
        ("learning rate of the context networks, over the same", |_, s| learning_rate(s.networks)),
        ("weight of the planes' reconstruction", |_, s| {
            if s.compresses_planes { s.reconstruction.to_string() } else { "–".to_owned() }
        }),
    ];
    row("**compression** (`tcgs`)", &|_| String::new());
    for (what, value) in rows {
        row(what, &|c| c.compression.as_ref().map_or_else(String::new, |s| value(c, s)));
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
    row("growth and pruning after", &|c| at(c, c.plain.densify_from));
    row("growth and pruning before", &|c| at(c, c.plain.densify_until));
    row("growth and pruning every", &|c| format!("{} steps", c.plain.densify_every));
    row("growth from a screen gradient of", &|c| c.plain.growth_threshold.to_string());
    row("opacities are reset every", &|c| at(c, c.plain.reset_every));
    row("a degree of spherical harmonics more every", &|c| at(c, c.plain.degree_every));
    row("learning rate of means, times the extent", &|c| learning_rate(c.plain.mean));
    row("learning rate of the constant color", &|c| format!("{:.3e}", c.plain.color));
    row("learning rate of the other coefficients", &|c| format!("{:.3e}", c.plain.coefficients));
    row("learning rate of opacity logits", &|c| c.plain.opacity.to_string());
    row("learning rate of log-scales", &|c| format!("{:.3e}", c.plain.log_scale));
    row("learning rate of quaternions", &|c| format!("{:.3e}", c.plain.quat));
}

fn learning_rate(decay: Decay) -> String {
    let Decay { start, end, shape } = decay;
    match shape {
        _ if start == end => format!("{start:?}"),
        DecayShape::Exponential => format!("{start:.3e} → {end:.3e}"),
        DecayShape::Quadratic => format!("{start:.3e} ↘ {end:.3e}"),
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
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../docs/SCHEDULE.md");
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
