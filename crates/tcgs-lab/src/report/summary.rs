//! Runs that differ in their seed alone, with the means and 95 % intervals of their figures, and comparisons of such groups.

use crate::bjontegaard::{CurveFit, RatePoint, psnr_difference, rate_difference};
use tcgs_codec::domain::{ModelKind, TrainOptions};
use tcgs_engine::eval::Estimate;

use super::record::RunRecord;

/// Levels of PSNR, in dB, whose seconds are told.
pub const LEVELS: [f64; 4] = [25.0, 28.0, 30.0, 32.0];

/// Runs of one set, model, schedule, weight and adapter, by seed.
#[derive(Debug, Clone)]
pub struct Group<'a> {
    pub runs: Vec<&'a RunRecord>,
    varying: Varying,
}

/// What the runs of a report differ in, so that names have to say it.
#[derive(Debug, Clone, Copy, Default)]
struct Varying {
    adapter: bool,
    preset: bool,
    background: bool,
}

impl Varying {
    fn of(records: &[RunRecord]) -> Self {
        Self {
            adapter: records.iter().any(|run| run.metrics.adapter != records[0].metrics.adapter),
            preset: records.iter().any(|run| run.options.preset != records[0].options.preset),
            background: records.iter().any(|run| run.options.background != records[0].options.background),
        }
    }
}

/// A figure of a run, if it has it.
type Figure = fn(&RunRecord) -> Option<f64>;

impl<'a> Group<'a> {
    /// The runs by group: sets, the groups of a set and the runs of a group in the order in which they first appear.
    pub fn all(records: &'a [RunRecord]) -> Vec<Self> {
        let varying = Varying::of(records);
        let mut groups: Vec<Self> = Vec::new();
        for record in records {
            match groups.iter_mut().find(|group| is_same_but_seed(group.first(), record)) {
                Some(group) => group.runs.push(record),
                None => groups.push(Self { runs: vec![record], varying }),
            }
        }
        let place = |group: &Self| records.iter().position(|record| record.set == group.set());
        groups.sort_by_key(place);
        groups
    }

    /// Its first run, which has what all of them share.
    pub fn first(&self) -> &'a RunRecord {
        self.runs[0]
    }

    pub fn set(&self) -> &'a str {
        &self.first().set
    }

    /// Steps of its runs: one number if they are the same.
    pub fn steps(&self) -> String {
        let steps = self.first().metrics.steps;
        if self.runs.iter().all(|run| run.metrics.steps == steps) {
            return steps.to_string();
        }
        let mean = self.estimate(|run| Some(run.metrics.steps as f64));
        mean.map_or_else(|| steps.to_string(), |mean| mean.text(0))
    }

    /// Model and weight, as `tcgs@0.002`.
    pub fn name(&self) -> String {
        let first = self.first();
        let weight = first.options.lambda.map_or_else(String::new, |lambda| format!("@{lambda}"));
        format!("{}{weight}{}", first.model, self.on_adapter())
    }

    /// The model, as `tcgs`.
    pub fn model(&self) -> String {
        format!("{}{}", self.first().model, self.on_adapter())
    }

    fn on_adapter(&self) -> String {
        if self.varying.adapter { format!(" on {}", self.first().adapter) } else { String::new() }
    }

    /// The model, or one name for plain Gaussians that are pruned to any number.
    pub fn family(&self) -> String {
        if self.is_pruned() { format!("pruned 3dgs{}", self.on_adapter()) } else { self.model() }
    }

    fn is_pruned(&self) -> bool {
        self.first().options.target_gaussians.is_some()
    }

    /// The curve that its point belongs to: models and schedule, as `tcgs, 300 steps`.
    pub fn curve_name(&self) -> String {
        format!("{}, {} steps{}", self.family(), self.first().metrics.steps, self.variant())
    }

    /// Preset and background, where the report has several.
    fn variant(&self) -> String {
        let options = &self.first().options;
        let mut text = String::new();
        if self.varying.preset {
            text.push_str(&format!(", {}", options.preset.name()));
        }
        if self.varying.background {
            text.push_str(&format!(", on {}", options.background.name()));
        }
        text
    }

    /// The mean of a figure over the seeds; `None` if a run lacks it.
    pub fn estimate(&self, figure: impl Fn(&RunRecord) -> Option<f64>) -> Option<Estimate> {
        let values: Option<Vec<f64>> = self.runs.iter().map(|run| figure(run)).collect();
        Estimate::of(&values?)
    }

    /// The mean over pairs of runs of equal seed of what `compare` makes of this group's run and the other's.
    pub fn paired(
        &self,
        other: &Group<'_>,
        compare: impl Fn(&RunRecord, &RunRecord) -> Option<f64>,
    ) -> Option<Estimate> {
        let pairs = self.runs.iter().filter_map(|run| {
            let same = other.runs.iter().find(|other| other.options.seed == run.options.seed)?;
            compare(run, same)
        });
        Estimate::of(&pairs.collect::<Vec<_>>())
    }

    /// The mean difference of a figure to the other's, over pairs.
    pub fn difference(
        &self,
        other: &Group<'_>,
        figure: impl Fn(&RunRecord) -> Option<f64>,
    ) -> Option<Estimate> {
        self.paired(other, |ours, theirs| Some(figure(ours)? - figure(theirs)?))
    }

    /// The mean ratio of a figure to the other's, over pairs.
    pub fn ratio(&self, other: &Group<'_>, figure: impl Fn(&RunRecord) -> f64) -> Option<Estimate> {
        self.paired(other, |ours, theirs| Some(figure(ours) / figure(theirs)))
    }

    /// The mean ratio of a time to the other's, over pairs of one session: others met the machine in different states.
    pub fn time_ratio(&self, other: &Group<'_>, time: impl Fn(&RunRecord) -> f64) -> Option<Estimate> {
        self.paired(other, |ours, theirs| (ours.session == theirs.session).then(|| time(ours) / time(theirs)))
    }

    /// Whether two groups can be compared at all: one set on one adapter, over one background.
    pub fn is_comparable(&self, other: &Group<'_>) -> bool {
        let [a, b] = [self.first(), other.first()];
        a.set == b.set
            && a.metrics.adapter == b.metrics.adapter
            && a.options.background == b.options.background
    }

    /// Whether it has the steps and the preset of the other.
    pub fn has_schedule_of(&self, other: &Group<'_>) -> bool {
        let [a, b] = [self.first(), other.first()];
        a.options.preset == b.options.preset
            && a.options.until == b.options.until
            && a.metrics.steps == b.metrics.steps
    }
}

fn is_same_but_seed(a: &RunRecord, b: &RunRecord) -> bool {
    let options = TrainOptions { seed: b.options.seed, ..a.options.clone() };
    a.set == b.set && a.model == b.model && a.metrics.adapter == b.metrics.adapter && options == b.options
}

/// The figures of the table of runs: name, decimals, value.
pub const FIGURES: [(&str, usize, Figure); 12] = [
    ("PSNR dB", 2, |run| run.metrics.test.psnr),
    ("SSIM", 4, |run| run.metrics.test.ssim),
    ("LPIPS", 4, |run| run.metrics.test.lpips),
    ("high-band error", 5, |run| run.high_band),
    ("bytes", 0, |run| Some(run.metrics.bytes.total as f64)),
    ("Gaussians", 0, |run| Some(run.metrics.gaussians as f64)),
    ("anchors", 0, |run| (run.metrics.anchors > 0).then_some(run.metrics.anchors as f64)),
    ("training s", 1, |run| Some(run.metrics.seconds.train)),
    ("steps/s", 2, |run| Some(run.metrics.steps_per_second)),
    ("encoding s", 3, |run| Some(run.metrics.seconds.encode)),
    ("decoding s", 4, |run| Some(run.least_decode_seconds())),
    ("ms a view", 1, |run| run.render_seconds.map(|seconds| 1e3 * seconds)),
];

/// A rate-distortion curve for each seed.
#[derive(Debug, Clone)]
pub struct Curve {
    pub set: String,
    pub name: String,
    adapter: String,
    /// Points of each seed, with the names of the runs or files that they are of.
    seeds: Vec<(u64, Vec<(String, RatePoint)>)>,
}

/// How one curve differs from another.
#[derive(Debug)]
pub struct CurveDifference {
    pub set: String,
    pub anchor: String,
    pub test: String,
    /// Per cent of the bytes at equal PSNR, and dB at equal bytes, by each fit.
    pub cubic: [Option<Estimate>; 2],
    pub pchip: [Option<Estimate>; 2],
}

impl Curve {
    /// The curves of all groups. A model with several weights has one for each schedule, through its weights; another model one through
    /// its schedules; the formats that a scene of plain Gaussians was converted to make one more. Plain Gaussians that are pruned to several
    /// numbers have one for each schedule, and one for each format that they are exported to.
    pub fn all(groups: &[Group<'_>]) -> Vec<Self> {
        let mut curves: Vec<Self> = Vec::new();
        for group in groups {
            let run = group.first();
            let is_weighted = groups.iter().any(|other| {
                other.is_comparable(group)
                    && other.first().model == run.model
                    && other.has_schedule_of(group)
                    && other.first().options.lambda != run.options.lambda
            });
            let name = if is_weighted {
                format!("{}, by weight", group.curve_name())
            } else if group.is_pruned() {
                format!("{}, by number", group.curve_name())
            } else {
                format!("{}{}, by steps", group.name(), group.variant())
            };
            // A model of several weights or numbers has one schedule in a curve, and another several steps.
            let label = format!("{} {}", group.name(), run.metrics.steps);
            for run in &group.runs {
                let point = run.metrics.test.psnr.map(|psnr| (run.metrics.bytes.total as f64, psnr));
                Self::add(&mut curves, run, &name, (&label, point));
                for export in run.exports.iter().filter(|_| group.is_pruned()) {
                    let name = format!("{} as {}, by number", group.curve_name(), export.format.name());
                    let point = export.psnr.map(|psnr| (export.bytes as f64, psnr));
                    Self::add(&mut curves, run, &name, (&label, point));
                }
                if run.options.model == ModelKind::Gaussians3d
                    && !group.is_pruned()
                    && !run.external_formats.is_empty()
                {
                    let name = format!("{}, by format", group.curve_name());
                    Self::add(&mut curves, run, &name, (&label, point));
                    for file in &run.external_formats {
                        let point = file.psnr.map(|psnr| (file.bytes as f64, psnr));
                        Self::add(&mut curves, run, &name, (&file.format, point));
                    }
                }
            }
        }
        // A single point has no curve.
        curves.retain(|curve| curve.seeds.iter().any(|(_, points)| points.len() > 1));
        curves
    }

    fn add(curves: &mut Vec<Self>, run: &RunRecord, name: &str, (label, point): (&str, Option<RatePoint>)) {
        let Some(point) = point.map(|point| (label.to_owned(), point)) else { return };
        let (set, adapter) = (run.set.clone(), run.metrics.adapter.clone());
        let is_it = |curve: &Self| curve.set == set && curve.adapter == adapter && curve.name == name;
        let place = curves.iter().position(is_it).unwrap_or_else(|| {
            curves.push(Self {
                set: set.clone(),
                adapter: adapter.clone(),
                name: name.to_owned(),
                seeds: Vec::new(),
            });
            curves.len() - 1
        });
        let seeds = &mut curves[place].seeds;
        match seeds.iter_mut().find(|(seed, _)| *seed == run.options.seed) {
            Some((_, points)) => points.push(point),
            None => seeds.push((run.options.seed, vec![point])),
        }
    }

    /// The points of one seed that the other seeds have too, so that curves of several seeds have the same ends.
    fn common(&self, seed: u64, seeds: &[u64]) -> Vec<RatePoint> {
        let of = |wanted: u64| self.seeds.iter().find(|(seed, _)| *seed == wanted).map(|(_, points)| points);
        let has = |seed: &u64, label: &str| {
            of(*seed).is_some_and(|points| points.iter().any(|(own, _)| own == label))
        };
        let points = of(seed).into_iter().flatten();
        points
            .filter(|(label, _)| seeds.iter().all(|seed| has(seed, label)))
            .map(|(_, point)| *point)
            .collect()
    }

    /// Every pair of curves of one set that share some range in every seed that both have.
    pub fn differences(curves: &[Self]) -> Vec<CurveDifference> {
        let mut found = Vec::new();
        for (place, anchor) in curves.iter().enumerate() {
            for test in &curves[place + 1..] {
                if anchor.set != test.set || anchor.adapter != test.adapter {
                    continue;
                }
                let difference = CurveDifference {
                    set: anchor.set.clone(),
                    anchor: anchor.name.clone(),
                    test: test.name.clone(),
                    cubic: anchor.difference(test, CurveFit::Cubic),
                    pchip: anchor.difference(test, CurveFit::Pchip),
                };
                if difference.pchip.iter().chain(&difference.cubic).any(Option::is_some) {
                    found.push(difference);
                }
            }
        }
        found
    }

    fn difference(&self, test: &Self, fit: CurveFit) -> [Option<Estimate>; 2] {
        let in_both = |seed: &u64| test.seeds.iter().any(|(other, _)| other == seed);
        let seeds: Vec<u64> = self.seeds.iter().map(|(seed, _)| *seed).filter(in_both).collect();
        let over_seeds = |difference: fn(&[RatePoint], &[RatePoint], CurveFit) -> Option<f64>| {
            let of_seed =
                |seed: &u64| difference(&self.common(*seed, &seeds), &test.common(*seed, &seeds), fit);
            // A mean over the seeds alone whose curves share a range would be one over a choice.
            let each: Option<Vec<f64>> = seeds.iter().map(of_seed).collect();
            Estimate::of(&each?)
        };
        [over_seeds(rate_difference), over_seeds(psnr_difference)]
    }
}

#[cfg(test)]
pub mod tests {
    use tcgs_codec::domain::{Background, Digest, Preset, SceneFormat};

    use super::*;
    use crate::report::{machine::Machine, record::ExportRecord};

    /// A record of a run with these figures.
    pub(in crate::report) fn record(
        model: ModelKind,
        lambda: Option<f64>,
        seed: u64,
        psnr: f64,
        bytes: u64,
    ) -> RunRecord {
        let scores = serde_json::json!({ "psnr": psnr, "ssim": 0.9, "lpips": null, "views": 2 });
        let metrics = serde_json::json!({
            "test": scores, "train": scores,
            "bytes": { "total": bytes, "positions": 0, "networks": 0, "planes": 0, "masks": 0, "features": 0, "scalings": 0, "offsets": 0, "container": bytes },
            "seconds": { "ingest": 0.1, "train": 10.0, "encode": 0.2, "decode": 0.05 },
            "steps": 100, "steps_per_second": 10.0, "anchors": 5, "gaussians": 50,
            "psnr_before_quantisation": null, "decode_sha256": Digest::of(b"decoded"), "adapter": "an adapter", "background": "black"
        });
        let machine = Machine { cores: 2, load: Some(1.0) };
        RunRecord {
            set: "ball".to_owned(),
            dataset: Digest::of(b"set"),
            model: model.name().to_owned(),
            options: TrainOptions { model, lambda, seed, ..TrainOptions::default() },
            adapter: "auto".to_owned(),
            session: "now".to_owned(),
            machine: [machine.clone(), machine],
            view_size: Some([16, 16]),
            metrics: serde_json::from_value(metrics).expect("metrics"),
            series: Vec::new(),
            decode_seconds: vec![0.04],
            render_seconds: Some(0.01),
            high_band: None,
            exports: Vec::new(),
            external_formats: Vec::new(),
        }
    }

    #[test]
    fn groups_of_a_set_stand_together() {
        let of = |set: &str, model| RunRecord { set: set.to_owned(), ..record(model, None, 0, 30.0, 1) };
        let (plain, anchors) = (ModelKind::Gaussians3d, ModelKind::Scaffold);
        let records = [of("fox", plain), of("chair", plain), of("fox", anchors), of("chair", anchors)];
        let groups = Group::all(&records);
        let names: Vec<String> = groups.iter().map(|it| format!("{} {}", it.set(), it.name())).collect();
        assert_eq!(names, ["fox 3dgs", "fox scaffold", "chair 3dgs", "chair scaffold"]);
    }

    #[test]
    fn seeds_are_means_and_pairs() {
        let records: Vec<RunRecord> = [(0, 30.0, 29.0), (1, 31.0, 30.5), (2, 32.0, 31.0)]
            .into_iter()
            .flat_map(|(seed, a, b)| {
                [
                    record(ModelKind::Scaffold, None, seed, a, 1000),
                    record(ModelKind::Tcgs, Some(0.001), seed, b, 100),
                ]
            })
            .collect();
        let groups = Group::all(&records);
        assert_eq!(groups.iter().map(Group::name).collect::<Vec<_>>(), ["scaffold", "tcgs@0.001"]);
        let psnr = groups[0].estimate(|run| run.metrics.test.psnr).expect("a mean");
        assert_eq!((psnr.mean, psnr.runs), (31.0, 3));
        let paired = groups[1].paired(&groups[0], |a, b| Some(a.metrics.test.psnr? - b.metrics.test.psnr?));
        let paired = paired.expect("pairs");
        assert!((paired.mean + 2.5 / 3.0).abs() < 1e-12, "{paired:?}");
    }

    #[test]
    fn curves_of_weights_are_compared_for_each_seed() {
        let mut records = Vec::new();
        for seed in 0..3 {
            for (place, lambda) in [0.004, 0.002, 0.001, 0.0005].into_iter().enumerate() {
                let psnr = 27.0 + place as f64 + 0.1 * seed as f64;
                let mut run = record(ModelKind::Tcgs, Some(lambda), seed, psnr, 1000 << place);
                records.push(run.clone());
                run.model = "tcgs-knn".to_owned();
                run.metrics.bytes.total *= 2;
                records.push(run);
            }
        }
        let groups = Group::all(&records);
        let curves = Curve::all(&groups);
        assert_eq!(curves.len(), 2, "{curves:?}");
        let differences = Curve::differences(&curves);
        assert_eq!(differences.len(), 1);
        for [rate, psnr] in [differences[0].cubic, differences[0].pchip] {
            let (rate, psnr) = (rate.expect("a rate"), psnr.expect("a PSNR"));
            assert!((rate.mean - 100.0).abs() < 1e-6 && rate.half_width.expect("seeds") < 1e-6, "{rate:?}");
            assert!((psnr.mean + 1.0).abs() < 1e-6 && psnr.runs == 3, "{psnr:?}");
        }
        // One seed whose curve is elsewhere.
        let mut elsewhere = curves.clone();
        elsewhere[1].seeds[2].1.iter_mut().for_each(|(_, (_, psnr))| *psnr += 40.0);
        let apart = &Curve::differences(&elsewhere)[0];
        assert_eq!(apart.cubic[0].or(apart.pchip[0]), None, "a mean over two of three seeds");
        assert_eq!(apart.pchip[1].expect("all share sizes").runs, 3);
        // One seed that goes further, where the curves differ more, than the others go.
        let mut longer = records;
        for (model, psnr) in [("tcgs", 31.0), ("tcgs-knn", 25.0)] {
            let mut run = record(ModelKind::Tcgs, Some(0.0002), 0, psnr, 40_000);
            run.model = model.to_owned();
            longer.push(run);
        }
        let same = &Curve::differences(&Curve::all(&Group::all(&longer)))[0];
        let rate = same.pchip[0].expect("a rate");
        assert!((rate.mean - 100.0).abs() < 1e-6 && rate.half_width.expect("seeds") < 1e-6, "{rate:?}");
    }

    #[test]
    fn pruned_gaussians_of_several_numbers_are_one_curve_in_each_format() {
        let mut records = Vec::new();
        for (place, number) in [1000, 2000].into_iter().enumerate() {
            let mut run = record(ModelKind::Gaussians3d, None, 0, 30.0 + place as f64, 8000 << place);
            run.model = format!("3dgs:{number}");
            run.options.target_gaussians = Some(number);
            run.exports = vec![ExportRecord {
                format: SceneFormat::Spz,
                bytes: 1000 << place,
                gaussians: number.into(),
                psnr: Some(29.0 + place as f64),
                psnr_to_source: 40.0,
            }];
            records.push(run);
        }
        records.push(record(ModelKind::Gaussians3d, None, 0, 33.0, 40_000));
        let groups = Group::all(&records);
        let curves = Curve::all(&groups);
        let names: Vec<_> = curves.iter().map(|curve| curve.name.as_str()).collect();
        assert_eq!(
            names,
            ["pruned 3dgs, 100 steps, by number", "pruned 3dgs, 100 steps as spz, by number"],
            "plain Gaussians alone are a point"
        );
        let points = curves[1].seeds[0].1.iter().map(|(_, point)| *point).collect::<Vec<_>>();
        assert_eq!((curves[1].seeds[0].0, points), (0, vec![(1000.0, 29.0), (2000.0, 30.0)]));
    }

    #[test]
    fn presets_and_backgrounds_have_curves_of_their_own() {
        let mut records = Vec::new();
        for (lambda, psnr, bytes) in [(0.001, 29.0, 2000), (0.002, 28.0, 1000)] {
            let run = record(ModelKind::Tcgs, Some(lambda), 0, psnr, bytes);
            let options = |preset, background| TrainOptions { preset, background, ..run.options.clone() };
            for (preset, background) in [
                (Preset::Preview, Background::Black),
                (Preset::Standard, Background::Black),
                (Preset::Preview, Background::White),
            ] {
                records.push(RunRecord { options: options(preset, background), ..run.clone() });
            }
        }
        let curves = Curve::all(&Group::all(&records));
        let names: Vec<&str> = curves.iter().map(|curve| curve.name.as_str()).collect();
        let name = |variant: &str| format!("tcgs, 100 steps, {variant}, by weight");
        assert_eq!(names, [name("preview, on black"), name("standard, on black"), name("preview, on white")]);
        assert!(curves.iter().all(|curve| curve.seeds[0].1.len() == 2), "{curves:?}");
    }
}
