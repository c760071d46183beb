//! What a report says: tables of means with their intervals, and the charts, by section.

use tcgs_codec::domain::{ByteCounts, CodingStages, RenderingError};
use tcgs_engine::eval::Estimate;

use super::{
    against_first::{against_first, of_pairs},
    cells::{decimal, shown, signed},
    conventions, equal_seconds,
    plots::Plots,
    published::Comparison,
    record::RunRecord,
    section::{Block, NONE, Row, Section, Table, texts},
    summary::{CurveDifference, FIGURES, Group, LEVELS},
    sweep::SweepRecord,
    worst_views::worst_tenth,
};

/// What a report is made from.
pub struct ReportContent<'a> {
    pub records: &'a [RunRecord],
    pub groups: &'a [Group<'a>],
    pub plots: &'a Plots,
    pub sweeps: &'a [SweepRecord],
    pub differences: &'a [CurveDifference],
    pub comparisons: &'a [Comparison],
    /// Runs that failed, and why.
    pub failed: Vec<String>,
    /// Runs of the matrix.
    pub wanted: usize,
}

/// A small mean with its interval, in powers of ten.
fn scientific(estimate: Option<Estimate>) -> String {
    let Some(Estimate { mean, half_width, .. }) = estimate else { return NONE.to_owned() };
    half_width.map_or_else(|| format!("{mean:.1e}"), |half| format!("{mean:.1e} ± {half:.0e}"))
}

impl ReportContent<'_> {
    /// Where the report stands, and what its figures are.
    pub fn introduction(&self) -> String {
        format!(
            "{} of {} runs are finished. Each figure is a mean over the seeds; ± is half of the 95 % interval of that mean by Student's t. \
             Where there is one seed there is no interval, and nothing is claimed from it.",
            self.records.len(),
            self.wanted
        )
    }

    /// The sections that there is something in.
    pub fn sections(&self) -> Vec<Section<'_>> {
        let Plots { time, bytes, decoding, rendering } = self.plots;
        let mut against_time = vec![Block::Charts(time)];
        against_time.extend(self.levels());
        let mut against_size = vec![Block::Charts(bytes)];
        against_size.extend(self.curves());
        let mut rendered = vec![Block::Charts(rendering)];
        rendered.extend(self.renders());
        let sections = [
            ("Failed runs", self.failed()),
            ("Runs", self.runs()),
            ("Against the first model", against_first(self.groups)),
            ("Equal seconds", self.equal_seconds()),
            ("Worst views", self.worst_views()),
            ("Quality against time", against_time),
            ("Where the bytes go", self.bytes()),
            ("Quality against size", against_size),
            ("Decoding", vec![Block::Charts(decoding)]),
            ("What each stage costs", self.stages()),
            ("Rendering", rendered),
            ("Published figures", self.published()),
            ("Machines and conventions", self.machines()),
        ];
        let is_filled = |section: &Section<'_>| {
            section.blocks.iter().any(|block| match block {
                Block::Charts(plots) => !plots.is_empty(),
                Block::Table(table) => !table.rows.is_empty(),
                Block::List(items) => !items.is_empty(),
                Block::Heading(_) | Block::Note(_) => false,
            })
        };
        let sections = sections.into_iter().map(|(title, blocks)| Section { title, blocks });
        sections.filter(is_filled).collect()
    }

    fn failed(&self) -> Vec<Block<'_>> {
        vec![Block::List(self.failed.clone())]
    }

    fn runs(&self) -> Vec<Block<'_>> {
        let mut head = group_head(&[]);
        head.extend(FIGURES.iter().map(|(name, ..)| (*name).to_owned()));
        let rows = self.groups.iter().map(|group| {
            let mut row = of_group(group);
            row.extend(FIGURES.iter().map(|(_, decimals, figure)| shown(group.estimate(figure), *decimals)));
            row
        });
        let mut blocks = vec![Block::Table(Table::new(head, rows))];
        blocks.extend(self.corrected().map(Block::Note));
        blocks
    }

    /// Which runs had color corrections of photographs; models of one table may differ in that.
    fn corrected(&self) -> Option<String> {
        let has = |run: &&&RunRecord| run.metrics.exposure.is_some_and(|exposure| exposure.corrected);
        let of_group = |group: &Group<'_>| {
            let count = group.runs.iter().filter(has).count();
            let seeds = if count < group.runs.len() {
                format!(" ({count} of {} seeds)", group.runs.len())
            } else {
                String::new()
            };
            (count > 0).then(|| format!("{} {} of {} steps{seeds}", group.set(), group.name(), group.steps()))
        };
        let named: Vec<String> = self.groups.iter().filter_map(of_group).collect();
        let is_any = !named.is_empty();
        is_any.then(|| {
            format!(
                "Color corrections of photographs were learnt by {}; all other runs had none. Seconds of training count the trial that decides.",
                named.join(", ")
            )
        })
    }

    /// How far the worst held-out views lie below the mean.
    fn worst_views(&self) -> Vec<Block<'_>> {
        let head = group_head(&["PSNR dB", "worst tenth dB", "below the mean dB"]);
        let worst = |run: &RunRecord| worst_tenth(&run.metrics.test);
        let below = |run: &RunRecord| Some(run.metrics.test.psnr? - worst(run)?);
        let measured = self.groups.iter().filter(|group| group.estimate(worst).is_some());
        let rows = measured.map(|group| {
            let mut row = of_group(group);
            row.push(shown(group.estimate(|run| run.metrics.test.psnr), 2));
            row.push(shown(group.estimate(worst), 2));
            row.push(shown(group.estimate(below), 2));
            row
        });
        let note = "The mean over the tenth of the held-out views with the lowest PSNR, at least one: views that look into reflections, \
            or at what few photographs show.";
        vec![Block::Table(Table::new(head, rows)), Block::Note(note.to_owned())]
    }

    /// What other models reach in the seconds of each.
    fn equal_seconds(&self) -> Vec<Block<'_>> {
        let head =
            texts(&["set", "model", "steps", "training s", "against", "pairs", "ΔPSNR dB", "bytes, ratio"]);
        let mut rows = Vec::new();
        for group in self.groups {
            for model in equal_seconds::models(self.groups, group) {
                let Some(difference) = equal_seconds::difference(self.groups, group, &model) else {
                    continue;
                };
                rows.push(vec![
                    group.set().to_owned(),
                    group.name(),
                    group.steps(),
                    shown(group.estimate(|run| Some(run.metrics.seconds.train)), 1),
                    model,
                    difference.psnr.runs.to_string(),
                    signed(Some(difference.psnr), 2),
                    shown(Some(difference.bytes), 4),
                ]);
            }
        }
        let note = "Each run against another model's runs of equal seed and session, between whose schedules PSNR and bytes are \
            interpolated at the run's own seconds of training; nothing is extrapolated.";
        vec![Block::Table(Table::new(head, rows)), Block::Note(note.to_owned())]
    }

    /// Bytes by section of the files that have sections.
    fn bytes(&self) -> Vec<Block<'_>> {
        let names = ByteCounts::default().parts().map(|(name, _)| name);
        let mut head = texts(&["set", "model", "steps", "seeds"]);
        head.extend(texts(&names));
        head.extend(texts(&["bytes", "3dgs / it", "scaffold / it"]));
        let mut rows = Vec::new();
        let coded = self.groups.iter().filter(|group| group.first().metrics.coding.is_some());
        for group in coded {
            let mut row = of_group(group);
            row.remove(2);
            let mean = |figure: &dyn Fn(&RunRecord) -> u64| {
                let estimate = group.estimate(|run| Some(figure(run) as f64));
                decimal(estimate.map(|estimate| estimate.mean), 0)
            };
            row.extend((0..names.len()).map(|at| mean(&|run| run.metrics.bytes.parts()[at].1)));
            row.push(mean(&|run| run.metrics.bytes.total));
            for model in ["3dgs", "scaffold"] {
                let is_it = |other: &&Group<'_>| {
                    other.is_comparable(group) && other.has_schedule_of(group) && other.first().model == model
                };
                let other = self.groups.iter().find(is_it);
                let times = other.and_then(|other| other.ratio(group, |run| run.metrics.bytes.total as f64));
                row.push(of_pairs(times, 1, group.runs.len()));
            }
            rows.push(row);
        }
        vec![Block::Table(Table::new(head, rows))]
    }

    fn levels(&self) -> Vec<Block<'_>> {
        let mut head = group_head(&[]);
        head.extend(LEVELS.map(|level| format!("s to {level} dB")));
        let is_reached = |run: &RunRecord| LEVELS.iter().any(|level| run.seconds_to(*level).is_some());
        let reached = self.groups.iter().filter(|group| group.runs.iter().any(|run| is_reached(run)));
        let rows = reached.map(|group| {
            let mut row = of_group(group);
            row.extend(LEVELS.map(|level| {
                let reached = group.runs.iter().filter(|run| run.seconds_to(level).is_some()).count();
                match group.estimate(|run| run.seconds_to(level)) {
                    Some(seconds) => seconds.text(1),
                    None if reached > 0 => format!("reached by {reached} of {}", group.runs.len()),
                    None => NONE.to_owned(),
                }
            }));
            row
        });
        let note = "Seconds of training until the training views just seen had that PSNR, as a mean of recent steps. It is not held-out \
            quality, which is measured once, at the end.";
        vec![Block::Table(Table::new(head, rows)), Block::Note(note.to_owned())]
    }

    fn curves(&self) -> Vec<Block<'_>> {
        let head = texts(&[
            "set",
            "curve",
            "against",
            "seeds",
            "bytes, cubic %",
            "bytes, PCHIP %",
            "PSNR, cubic dB",
            "PSNR, PCHIP dB",
        ]);
        let rows = self.differences.iter().map(|difference| {
            let CurveDifference { set, anchor, test, cubic, pchip } = difference;
            let seeds = pchip.iter().chain(cubic).flatten().map(|estimate| estimate.runs).max();
            vec![
                set.clone(),
                test.clone(),
                anchor.clone(),
                seeds.unwrap_or(0).to_string(),
                signed(cubic[0], 1),
                signed(pchip[0], 1),
                signed(cubic[1], 2),
                signed(pchip[1], 2),
            ]
        });
        let table = Table::new(head, rows);
        let heading = Block::Heading("Bjøntegaard differences".to_owned());
        if table.rows.is_empty() {
            let none = "No two curves share a range in every seed; a curve goes through several weights, steps or formats.";
            return vec![heading, Block::Note(none.to_owned())];
        }
        let note = "Mean difference of bytes at equal PSNR (less is smaller) and of PSNR at equal bytes, over the range that both curves \
                    have. It is a mean over seeds, if all of them have such a range. The cubic fit takes four points, PCHIP two.";
        vec![heading, Block::Table(table), Block::Note(note.to_owned())]
    }

    /// What each stage between training and the decoded file costs.
    fn stages(&self) -> Vec<Block<'_>> {
        let head = group_head(&[
            "floats dB",
            "noise − floats",
            "rounding − floats",
            "noise − rounding",
            "quantized networks",
            "file − floats",
            "integer / float bits",
            "bytes / ideal",
            "f32 − f64 rms",
            "largest",
            "cut-offs rms",
        ]);
        let rows = self.groups.iter().map(|group| {
            let stage =
                |figure: fn(CodingStages) -> f64| group.estimate(|run| run.metrics.stages.map(figure));
            let error =
                |figure: fn(RenderingError) -> f64| group.estimate(|run| run.metrics.rendering.map(figure));
            let mut row = of_group(group);
            row.extend([
                shown(stage(|stages| stages.floats), 2),
                signed(stage(|stages| stages.noise - stages.floats), 3),
                signed(stage(|stages| stages.rounded - stages.floats), 3),
                signed(stage(|stages| stages.noise - stages.rounded), 3),
                signed(stage(|stages| stages.decoded - stages.rounded), 3),
                signed(stage(|stages| stages.decoded - stages.floats), 3),
                shown(group.estimate(|run| run.metrics.coding?.over_floats), 4),
                shown(group.estimate(|run| Some(run.metrics.coding?.entropy_overhead)), 4),
                scientific(error(|error| error.rmse)),
                scientific(error(|error| error.max)),
                scientific(error(|error| error.cutoff_rmse)),
            ]);
            row
        });
        let note = "dB are differences of held-out PSNR over the same few views; floats are attributes and networks as trained, before any \
            rounding. Bits are those of the integer context networks over those of the float networks they were made of. * marks means whose \
            interval excludes zero.";
        let mut blocks = vec![Block::Table(Table::new(head, rows)), Block::Note(note.to_owned())];
        if self.records.iter().any(|run| run.metrics.rendering.is_some()) {
            let note = "The last three columns are of colors from 0 to 1: the renderer against the f64 reference on the decoded scene, and \
                the reference against itself without the cut-offs of blending.";
            blocks.push(Block::Note(note.to_owned()));
        }
        let exports = self.exports();
        if !exports.rows.is_empty() {
            let note =
                "Formats of plain Gaussians; anchors are baked for the training cameras and refined first.";
            blocks.extend([
                Block::Heading("Exports".to_owned()),
                Block::Table(exports),
                Block::Note(note.to_owned()),
            ]);
        }
        blocks
    }

    fn exports(&self) -> Table {
        let head = texts(&[
            "set",
            "model",
            "steps",
            "format",
            "seeds",
            "bytes",
            "PSNR dB",
            "Δ to the file dB",
            "PSNR to the file dB",
        ]);
        let mut rows = Vec::new();
        for group in self.groups {
            let mut add = |format: &str, figures: [Option<Estimate>; 4]| {
                let [bytes, psnr, lost, to_file] = figures;
                rows.push(vec![
                    group.set().to_owned(),
                    group.name(),
                    group.steps(),
                    format.to_owned(),
                    group.runs.len().to_string(),
                    shown(bytes, 0),
                    shown(psnr, 2),
                    signed(lost, 3),
                    shown(to_file, 2),
                ]);
            };
            for export in &group.first().exports {
                let of =
                    |run: &RunRecord| run.exports.iter().find(|other| other.format == export.format).cloned();
                let figures = [
                    group.estimate(|run| Some(of(run)?.bytes as f64)),
                    group.estimate(|run| of(run)?.psnr),
                    group.estimate(|run| Some(of(run)?.psnr? - run.metrics.test.psnr?)),
                    group.estimate(|run| Some(of(run)?.psnr_to_source)),
                ];
                add(export.format.name(), figures);
            }
            for file in &group.first().external_formats {
                let of = |run: &RunRecord| {
                    run.external_formats.iter().find(|other| other.format == file.format).cloned()
                };
                let figures = [
                    group.estimate(|run| Some(of(run)?.bytes as f64)),
                    group.estimate(|run| of(run)?.psnr),
                    group.estimate(|run| Some(of(run)?.psnr? - run.metrics.test.psnr?)),
                    None,
                ];
                add(&file.format, figures);
            }
        }
        Table::new(head, rows)
    }

    fn renders(&self) -> Vec<Block<'_>> {
        let Some(one) = self.sweeps.first() else { return Vec::new() };
        let head = texts(&[
            "Gaussians",
            "pixels",
            "kernels",
            "ms, least",
            "to the first",
            "f32 − f64 rms",
            "largest",
            "cut-offs rms",
            "reference s",
            "load",
        ]);
        let rows = self.sweeps.iter().flat_map(|sweep| {
            let first = sweep.variants.first().map_or(f64::NAN, |variant| variant.fastest_ms());
            sweep.variants.iter().map(move |variant| {
                vec![
                    sweep.gaussians.to_string(),
                    format!("{0} x {0}", sweep.side),
                    variant.name.clone(),
                    format!("{:.2}", variant.fastest_ms()),
                    format!("{:.2}", variant.fastest_ms() / first),
                    format!("{:.1e}", variant.error.rmse),
                    format!("{:.1e}", variant.error.max),
                    format!("{:.1e}", sweep.cutoff_rmse),
                    format!("{:.2}", sweep.reference_seconds),
                    decimal(sweep.machine[1].load, 1),
                ]
            })
        });
        let note = format!(
            "Made scenes on {}. The renderer culls Gaussians that reach no tile and sorts the others by depth and by tile with one stable \
             radix sort. It has no other algorithm to compare, so the variants are ways of dividing that work among lanes. What skipping \
             faint contributions costs is told by the reference, with and without cut-offs.",
            one.adapter[1]
        );
        vec![Block::Table(Table::new(head, rows)), Block::Note(note)]
    }

    fn published(&self) -> Vec<Block<'_>> {
        let note = "Facts from published tables, shown because these sets are scenes of the same datasets. Hardware, steps and image \
            sources differ; LPIPS may be by another network. MB are 10⁶ bytes.";
        let mut blocks = vec![Block::Note(note.to_owned())];
        blocks.extend(self.comparisons.iter().flat_map(|comparison| self.comparison(comparison)));
        blocks
    }

    fn comparison(&self, comparison: &Comparison) -> Vec<Block<'_>> {
        let mut rows: Vec<(f64, bool, Vec<String>)> = comparison
            .rows
            .iter()
            .map(|row| {
                let cells = vec![
                    row.method.clone(),
                    format!("{:.2}", row.psnr),
                    decimal(row.ssim, 3),
                    decimal(row.lpips, 3),
                    format!("{:.2}", row.bytes as f64 / 1e6),
                    row.source.clone(),
                ];
                (row.bytes as f64, false, cells)
            })
            .collect();
        if let [set] = comparison.sets.as_slice() {
            for group in self.groups.iter().filter(|group| group.set() == set) {
                let Some(bytes) = group.estimate(|run| Some(run.metrics.bytes.total as f64 / 1e6)) else {
                    continue;
                };
                let cells = vec![
                    format!("ours: {}, {} steps", group.name(), group.first().metrics.steps),
                    shown(group.estimate(|run| run.metrics.test.psnr), 2),
                    shown(group.estimate(|run| run.metrics.test.ssim), 3),
                    shown(group.estimate(|run| run.metrics.test.lpips), 3),
                    bytes.text(2),
                    format!("this report, {} seeds", group.runs.len()),
                ];
                rows.push((1e6 * bytes.mean, true, cells));
            }
        } else {
            rows.extend(self.means_over(&comparison.sets));
        }
        rows.sort_by(|a, b| a.0.total_cmp(&b.0));
        let mut blocks = vec![Block::Heading(comparison.subject.clone())];
        blocks.extend(comparison.caution.iter().map(|caution| Block::Note(format!("Note: {caution}."))));
        let head = texts(&["method", "PSNR dB", "SSIM", "LPIPS", "MB", "source"]);
        let rows = rows.into_iter().map(|(_, is_own, cells)| Row { cells, is_own }).collect();
        blocks.push(Block::Table(Table { head, rows }));
        blocks
    }

    /// Means over the sets of a dataset, of models that all of them have.
    fn means_over(&self, sets: &[String]) -> Vec<(f64, bool, Vec<String>)> {
        let Some(one) = sets.first() else { return Vec::new() };
        let of_dataset = |group: &Group<'_>| -> Option<Vec<&Group<'_>>> {
            let same = |other: &Group<'_>| other.name() == group.name() && other.has_schedule_of(group);
            let of_set = |set: &String| self.groups.iter().find(|other| other.set() == set && same(other));
            sets.iter().map(of_set).collect()
        };
        let row = |group: &Group<'_>| {
            let groups = of_dataset(group)?;
            let mean = |figure: fn(&RunRecord) -> Option<f64>| -> Option<f64> {
                let each: Option<Vec<f64>> =
                    groups.iter().map(|group| Some(group.estimate(figure)?.mean)).collect();
                each.map(|each| each.iter().sum::<f64>() / each.len() as f64)
            };
            let bytes = mean(|run| Some(run.metrics.bytes.total as f64))?;
            let cells = vec![
                format!("ours: {}, {} steps", group.name(), group.first().metrics.steps),
                decimal(mean(|run| run.metrics.test.psnr), 2),
                decimal(mean(|run| run.metrics.test.ssim), 3),
                decimal(mean(|run| run.metrics.test.lpips), 3),
                format!("{:.2}", bytes / 1e6),
                "this report, mean over the scenes".to_owned(),
            ];
            Some((bytes, true, cells))
        };
        self.groups.iter().filter(|group| group.set() == one).filter_map(row).collect()
    }

    /// Where the runs were made: a row for each adapter and session.
    fn machines(&self) -> Vec<Block<'_>> {
        let mut rows: Vec<Vec<String>> = Vec::new();
        let mut loads: Vec<Vec<f64>> = Vec::new();
        for run in self.records {
            let key =
                vec![run.metrics.adapter.clone(), run.session.clone(), run.machine[1].cores.to_string()];
            let place = rows.iter().position(|row| *row == key).unwrap_or_else(|| {
                rows.push(key);
                loads.push(Vec::new());
                rows.len() - 1
            });
            loads[place].extend(run.machine.iter().filter_map(|machine| machine.load));
        }
        for (row, loads) in rows.iter_mut().zip(loads) {
            let (low, high) =
                loads.iter().fold((f64::INFINITY, 0.0), |(low, high), load| (load.min(low), load.max(high)));
            row.push(if loads.is_empty() { "unknown".to_owned() } else { format!("{low:.1} to {high:.1}") });
        }
        let head = texts(&["adapter and driver", "session began", "cores", "load average"]);
        let mut blocks = vec![Block::Table(Table::new(head, rows))];
        blocks.extend(conventions::by_set(self.records).into_iter().map(Block::Note));
        blocks
    }
}

/// The head of a table whose rows begin with [`of_group`].
fn group_head(figures: &[&str]) -> Vec<String> {
    let mut head = texts(&["set", "model", "preset", "steps", "seeds"]);
    head.extend(texts(figures));
    head
}

fn of_group(group: &Group<'_>) -> Vec<String> {
    let first = group.first();
    vec![
        group.set().to_owned(),
        group.name(),
        first.options.preset.to_string(),
        group.steps(),
        group.runs.len().to_string(),
    ]
}
