//! What one model reaches in the seconds that a run of another took.
//!
//! A model's runs with several schedules are points of a curve: PSNR and the logarithm of the bytes, each linear in the logarithm of the
//! seconds between neighboring points. Every point is a whole schedule, so its learning rates have fallen by its end. Nothing is
//! extrapolated, and only runs of one seed and session are compared, which met the machine in the same state.

use tcgs_engine::eval::Estimate;

use super::{record::RunRecord, summary::Group};

/// How a model differs from another that is given the same seconds, over seeds.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Difference {
    /// PSNR of the model less the other's, in dB.
    pub psnr: Estimate,
    /// Bytes of the model over the other's.
    pub bytes: Estimate,
}

/// The other models that a group can be compared with, in the order of the groups: whole curves, without a weight of their own.
pub fn models(groups: &[Group<'_>], group: &Group<'_>) -> Vec<String> {
    let mut names: Vec<String> = Vec::new();
    for other in groups {
        let name = other.model();
        let is_other = other.is_comparable(group) && name != group.model();
        if is_other && is_curve_of(other, &name) && !names.contains(&name) {
            names.push(name);
        }
    }
    names
}

/// Whether the group belongs to the curve of `model` over schedules, which has no weight of its own.
fn is_curve_of(group: &Group<'_>, model: &str) -> bool {
    group.first().options.lambda.is_none() && group.model() == model
}

/// The difference to the runs of `model`; `None` if no run of the group took seconds within their range.
pub fn difference(groups: &[Group<'_>], group: &Group<'_>, model: &str) -> Option<Difference> {
    let others: Vec<&RunRecord> = groups
        .iter()
        .filter(|other| is_curve_of(other, model) && other.is_comparable(group))
        .flat_map(|other| other.runs.iter().copied())
        .collect();
    let mut differences = Vec::new();
    for run in &group.runs {
        let same = others.iter().filter(|other| {
            other.options.seed == run.options.seed
                && other.options.preset == run.options.preset
                && other.session == run.session
        });
        let points: Option<Vec<Point>> = same.map(|other| Point::of(other)).collect();
        let ours = Point::of(run)?;
        // A seed that cannot be compared would leave a mean over the others alone.
        differences.push((ours, at(points?, ours.ln_seconds)?));
    }
    let psnr: Vec<f64> = differences.iter().map(|(ours, theirs)| ours.psnr - theirs.psnr).collect();
    let bytes: Vec<f64> =
        differences.iter().map(|(ours, theirs)| (ours.ln_bytes - theirs.ln_bytes).exp()).collect();
    Some(Difference { psnr: Estimate::of(&psnr)?, bytes: Estimate::of(&bytes)? })
}

/// A finished run as a point of its model's curve.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Point {
    ln_seconds: f64,
    psnr: f64,
    ln_bytes: f64,
}

impl Point {
    fn of(run: &RunRecord) -> Option<Self> {
        Some(Self {
            ln_seconds: run.metrics.seconds.train.ln(),
            psnr: run.metrics.test.psnr?,
            ln_bytes: (run.metrics.bytes.total as f64).ln(),
        })
    }
}

/// The curve through `points` at `ln_seconds`; `None` outside.
fn at(mut points: Vec<Point>, ln_seconds: f64) -> Option<Point> {
    points.sort_by(|a, b| a.ln_seconds.total_cmp(&b.ln_seconds));
    let after = points.iter().position(|point| point.ln_seconds >= ln_seconds)?;
    let before = match after.checked_sub(1) {
        Some(before) => points[before],
        None if points[after].ln_seconds == ln_seconds => return Some(points[after]),
        None => return None,
    };
    let after = points[after];
    let share = (ln_seconds - before.ln_seconds) / (after.ln_seconds - before.ln_seconds);
    let between = |a: f64, b: f64| a + share * (b - a);
    Some(Point {
        ln_seconds,
        psnr: between(before.psnr, after.psnr),
        ln_bytes: between(before.ln_bytes, after.ln_bytes),
    })
}

#[cfg(test)]
mod tests {
    use tcgs_codec::domain::{ModelKind, TrainOptions};

    use super::{super::summary::tests::record, *};

    fn run(model: ModelKind, seed: u64, seconds: f64, psnr: f64, bytes: u64) -> RunRecord {
        let mut run = record(model, None, seed, psnr, bytes);
        run.metrics.seconds.train = seconds;
        run.metrics.steps = (10.0 * seconds) as u64;
        run.options.iterations = Some((10.0 * seconds) as u32);
        run
    }

    #[test]
    fn a_curve_is_followed_between_its_points_and_not_beyond() {
        let mut records = vec![run(ModelKind::Tcgs, 0, 20.0, 29.0, 100)];
        records.push(run(ModelKind::Gaussians3d, 0, 40.0, 32.0, 4000));
        records.push(run(ModelKind::Gaussians3d, 0, 10.0, 28.0, 1000));
        let groups = Group::all(&records);
        assert_eq!(models(&groups, &groups[0]), ["3dgs"]);
        let found = difference(&groups, &groups[0], "3dgs").expect("within");
        assert!((found.psnr.mean + 1.0).abs() < 1e-12, "half way in the logarithm: {found:?}");
        assert!((found.bytes.mean - 0.05).abs() < 1e-12, "{found:?}");
        assert_eq!(found.psnr.half_width, None);
        let mut weighted = records.clone();
        weighted.push(RunRecord {
            options: TrainOptions { lambda: Some(0.01), ..records[2].options.clone() },
            ..run(ModelKind::Gaussians3d, 0, 21.0, 20.0, 10)
        });
        let groups_with_it = Group::all(&weighted);
        assert_eq!(difference(&groups_with_it, &groups_with_it[0], "3dgs"), Some(found), "another weight");
        // The slowest run of 3dgs took longer than any of tcgs.
        assert_eq!(difference(&groups, &groups[1], "tcgs"), None);
    }

    #[test]
    fn every_seed_has_to_be_within_and_sessions_do_not_mix() {
        let mut records = Vec::new();
        for seed in 0..2 {
            records.push(run(ModelKind::Tcgs, seed, 20.0, 29.0, 100));
            records.push(run(ModelKind::Gaussians3d, seed, 10.0, 28.0, 1000));
            records.push(run(ModelKind::Gaussians3d, seed, 40.0, 30.0 + seed as f64, 4000));
        }
        let found = |records: &[RunRecord]| {
            let groups = Group::all(records);
            difference(&groups, &groups[0], "3dgs")
        };
        let both = found(&records).expect("within");
        assert!((both.psnr.mean + 0.25).abs() < 1e-12 && both.psnr.runs == 2, "{both:?}");
        let mut slow = records.clone();
        slow[3].metrics.seconds.train = 41.0;
        assert_eq!(found(&slow), None, "beyond the curve of its seed");
        let mut other = records.clone();
        other[2].session = "another day".to_owned();
        assert_eq!(found(&other), None);
    }
}
