//! The report as one page that needs nothing else: tables of means with their intervals, charts as inline SVG.

use maud::{DOCTYPE, Markup, PreEscaped, html};
use tcgs::{
    domain::{CodingStages, RenderingError},
    eval::Estimate,
};

use super::{
    plots::{Plot, Plots},
    published::Comparison,
    record::RunRecord,
    summary::{CurveDifference, FIGURES, Group, LEVELS},
    sweep::SweepRecord,
};

const STYLE: &str = include_str!("style.css");

/// What the page is made from.
pub(super) struct Page<'a> {
    pub(super) records: &'a [RunRecord],
    pub(super) groups: &'a [Group<'a>],
    pub(super) plots: &'a Plots,
    pub(super) sweeps: &'a [SweepRecord],
    pub(super) differences: &'a [CurveDifference],
    pub(super) comparisons: &'a [Comparison],
    /// Runs that failed, and why.
    pub(super) failed: Vec<String>,
    /// Runs of the matrix.
    pub(super) wanted: usize,
}

/// A table of texts.
struct Table {
    head: Vec<String>,
    rows: Vec<Vec<String>>,
}

impl Table {
    fn markup(&self) -> Markup {
        html! {
            div.wide { table {
                thead { tr { @for cell in &self.head { th scope="col" { (cell) } } } }
                tbody { @for row in &self.rows { tr { @for cell in row { td { (cell) } } } } }
            } }
        }
    }
}

fn texts(names: &[&str]) -> Vec<String> {
    names.iter().map(|name| (*name).to_owned()).collect()
}

/// A mean with its interval, or a dash.
fn shown(estimate: Option<Estimate>, decimals: usize) -> String {
    estimate.map_or_else(|| "–".to_owned(), |estimate| estimate.text(decimals))
}

/// A difference with its interval, signed, with a star where the interval excludes zero.
fn signed(estimate: Option<Estimate>, decimals: usize) -> String {
    let Some(estimate) = estimate else { return "–".to_owned() };
    let sign = if estimate.mean >= 0.0 { "+" } else { "" };
    let star = if estimate.excludes_zero() == Some(true) { " *" } else { "" };
    format!("{sign}{}{star}", estimate.text(decimals))
}

/// A small mean with its interval, in powers of ten.
fn scientific(estimate: Option<Estimate>) -> String {
    let Some(Estimate { mean, half_width, .. }) = estimate else { return "–".to_owned() };
    half_width.map_or_else(|| format!("{mean:.1e}"), |half| format!("{mean:.1e} ± {half:.0e}"))
}

impl Page<'_> {
    pub(super) fn html(&self) -> String {
        let Plots { time, bytes, decoding, rendering } = self.plots;
        let page = html! {
            (DOCTYPE)
            html lang="en" {
                head {
                    meta charset="utf-8";
                    meta name="viewport" content="width=device-width, initial-scale=1";
                    title { "Speed against error" }
                    style { (PreEscaped(STYLE)) }
                }
                body {
                    header { h1 { "Speed against error" } (self.standing()) }
                    main {
                        (self.runs())
                        (self.to_first())
                        (section("Quality against time", charts(time)))
                        (self.levels())
                        (section("Quality against size", charts(bytes)))
                        (self.curves())
                        (section("Decoding", charts(decoding)))
                        (self.stages())
                        (section("Rendering", charts(rendering)))
                        (self.renders())
                        (self.published())
                        (self.machines())
                    }
                    footer { p { "Made by tcgs " (env!("CARGO_PKG_VERSION")) " bench report. Figures are of the decoded files on held-out views unless a table says otherwise." } }
                }
            }
        };
        page.into_string()
    }

    fn standing(&self) -> Markup {
        html! {
            p {
                (self.records.len()) " of " (self.wanted) " runs are finished. Each figure is a mean over the seeds; ± is half of the 95 % \
                interval of that mean by Student's t. Where there is one seed there is no interval, and nothing is claimed from it."
            }
            @if !self.failed.is_empty() {
                h2 { "Failed runs" }
                ul { @for run in &self.failed { li { (run) } } }
            }
        }
    }

    fn runs(&self) -> Markup {
        let mut head = texts(&["set", "model", "preset", "steps", "seeds"]);
        head.extend(FIGURES.iter().map(|(name, ..)| (*name).to_owned()));
        let rows = self.groups.iter().map(|group| {
            let mut row = of_group(group);
            row.extend(FIGURES.iter().map(|(_, decimals, figure)| shown(group.estimate(figure), *decimals)));
            row
        });
        let table = Table { head, rows: rows.collect() };
        section("Runs", table.markup())
    }

    /// Every group against the first of its set and schedule, by pairs of equal seed.
    fn to_first(&self) -> Markup {
        let head = texts(&[
            "set",
            "model",
            "against",
            "steps",
            "pairs",
            "ΔPSNR dB",
            "ΔSSIM",
            "bytes, ratio",
            "training s, ratio",
            "decoding s, ratio",
        ]);
        let mut rows = Vec::new();
        for (place, group) in self.groups.iter().enumerate() {
            let is_first = |other: &&Group<'_>| other.is_comparable(group) && other.has_schedule_of(group);
            let Some(first) = self.groups[..place].iter().find(is_first) else { continue };
            let ratio = |figure: fn(&RunRecord) -> f64| {
                group.paired(first, |ours, other| Some(figure(ours) / figure(other)))
            };
            // Times of different sessions met the machine in different states.
            let timed = |figure: fn(&RunRecord) -> f64| {
                group.paired(first, |ours, other| {
                    (ours.session == other.session).then(|| figure(ours) / figure(other))
                })
            };
            let psnr = group.paired(first, |a, b| Some(a.metrics.test.psnr? - b.metrics.test.psnr?));
            let ssim = group.paired(first, |a, b| Some(a.metrics.test.ssim? - b.metrics.test.ssim?));
            rows.push(vec![
                group.set().to_owned(),
                group.name(),
                first.name(),
                group.first().metrics.steps.to_string(),
                psnr.map_or(0, |psnr| psnr.runs).to_string(),
                signed(psnr, 2),
                signed(ssim, 4),
                shown(ratio(|run| run.metrics.bytes.total as f64), 4),
                shown(timed(|run| run.metrics.seconds.train), 2),
                shown(timed(RunRecord::least_decode_seconds), 2),
            ]);
        }
        html! {
            (section("Against the first model", Table { head, rows }.markup()))
            p { "Pairs of runs of equal seed, set and steps. * marks differences whose interval excludes zero. Ratios of times are \
                taken only between runs of one session of this command, which makes models of one seed one after another." }
        }
    }

    fn levels(&self) -> Markup {
        let mut head = texts(&["set", "model", "preset", "steps", "seeds"]);
        head.extend(LEVELS.map(|level| format!("s to {level} dB")));
        let rows = self.groups.iter().map(|group| {
            let mut row = of_group(group);
            row.extend(LEVELS.map(|level| {
                let reached = group.runs.iter().filter(|run| run.seconds_to(level).is_some()).count();
                match group.estimate(|run| run.seconds_to(level)) {
                    Some(seconds) => seconds.text(1),
                    None if reached > 0 => format!("reached by {reached} of {}", group.runs.len()),
                    None => "–".to_owned(),
                }
            }));
            row
        });
        let table = Table { head, rows: rows.collect() };
        html! {
            (table.markup())
            p { "Seconds of training until the training views just seen had that PSNR, as a mean of recent steps. It is not held-out \
                quality, which is measured once, at the end." }
        }
    }

    fn curves(&self) -> Markup {
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
        let table = Table { head, rows: rows.collect() };
        html! {
            h3 { "Bjøntegaard differences" }
            @if table.rows.is_empty() {
                p.none { "No two curves share a range: a curve has several weights, steps or formats." }
            } @else {
                (table.markup())
                p { "Mean difference of bytes at equal PSNR (less is smaller) and of PSNR at equal bytes, over the range that both \
                    curves have, for each seed and then over seeds. The cubic fit takes four points, PCHIP two." }
            }
        }
    }

    /// What each stage between training and the decoded file costs.
    fn stages(&self) -> Markup {
        let head = texts(&[
            "set",
            "model",
            "preset",
            "steps",
            "seeds",
            "floats dB",
            "noise − floats",
            "rounding − floats",
            "noise − rounding",
            "8-bit networks",
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
        let table = Table { head, rows: rows.collect() };
        let exports = self.exports();
        html! {
            (section("What each stage costs", table.markup()))
            p { "dB are differences of held-out PSNR over the same few views; floats are attributes and networks as trained, before any \
                rounding. Bits are those of the integer context networks over those of the float networks they were made of. The last \
                three columns are of colours from 0 to 1: the renderer against the f64 reference on the decoded scene, and the \
                reference against itself without the cut-offs of blending. * marks means whose interval excludes zero." }
            @if !exports.rows.is_empty() {
                h3 { "Exports" }
                (exports.markup())
                p { "Formats of plain Gaussians; anchors are baked for the training cameras first." }
            }
        }
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
                    group.first().metrics.steps.to_string(),
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
        Table { head, rows }
    }

    fn renders(&self) -> Markup {
        if self.sweeps.is_empty() {
            return html! {};
        }
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
            let first = sweep.variants.first().map_or(f64::NAN, |variant| variant.least());
            sweep.variants.iter().map(move |variant| {
                vec![
                    sweep.gaussians.to_string(),
                    format!("{0} x {0}", sweep.side),
                    variant.name.clone(),
                    format!("{:.2}", variant.least()),
                    format!("{:.2}", variant.least() / first),
                    format!("{:.1e}", variant.error.rmse),
                    format!("{:.1e}", variant.error.max),
                    format!("{:.1e}", sweep.cutoff_rmse),
                    format!("{:.2}", sweep.reference_seconds),
                    sweep.machine[1].load.map_or_else(|| "–".to_owned(), |load| format!("{load:.1}")),
                ]
            })
        });
        let table = Table { head, rows: rows.collect() };
        html! {
            (table.markup())
            p {
                "Made scenes on " (self.sweeps[0].adapter[1]) ". The renderer culls Gaussians that reach no tile and sorts the others by \
                depth and by tile with one stable radix sort; it has no other algorithm to compare, so the variants are ways of dividing \
                that work among lanes. What skipping faint contributions costs is told by the reference, with and without cut-offs."
            }
        }
    }

    fn published(&self) -> Markup {
        if self.comparisons.is_empty() {
            return html! {};
        }
        html! {
            section {
                h2 { "Published figures" }
                p { "Facts from published tables, shown because these sets are scenes of the same datasets. Hardware, steps and image \
                    sources differ; LPIPS may be by another network. MB are 10⁶ bytes." }
                @for comparison in self.comparisons { (self.comparison(comparison)) }
            }
        }
    }

    fn comparison(&self, comparison: &Comparison) -> Markup {
        let mut rows: Vec<(f64, bool, Vec<String>)> = comparison
            .rows
            .iter()
            .map(|row| {
                let cells = vec![
                    row.method.clone(),
                    format!("{:.2}", row.psnr),
                    format!("{:.3}", row.ssim),
                    format!("{:.3}", row.lpips),
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
        html! {
            h3 { (comparison.subject) }
            @if let Some(caution) = &comparison.caution { p { "Note: " (caution) "." } }
            div.wide { table {
                thead { tr { @for name in ["method", "PSNR dB", "SSIM", "LPIPS", "MB", "source"] { th scope="col" { (name) } } } }
                tbody {
                    @for (_, is_ours, cells) in &rows {
                        tr.ours[*is_ours] { @for cell in cells { td { (cell) } } }
                    }
                }
            } }
        }
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
            let text = |value: Option<f64>, decimals: usize| {
                value.map_or_else(|| "–".to_owned(), |value| format!("{value:.decimals$}"))
            };
            let bytes = mean(|run| Some(run.metrics.bytes.total as f64))?;
            let cells = vec![
                format!("ours: {}, {} steps", group.name(), group.first().metrics.steps),
                text(mean(|run| run.metrics.test.psnr), 2),
                text(mean(|run| run.metrics.test.ssim), 3),
                text(mean(|run| run.metrics.test.lpips), 3),
                format!("{:.2}", bytes / 1e6),
                "this report, mean over the scenes".to_owned(),
            ];
            Some((bytes, true, cells))
        };
        self.groups.iter().filter(|group| group.set() == one).filter_map(row).collect()
    }

    /// Where the runs were made: a row for each adapter and session.
    fn machines(&self) -> Markup {
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
        let conventions = self.records.first().map(|run| run.metrics.conventions.to_string());
        html! {
            (section("Machines and conventions", Table { head, rows }.markup()))
            @if let Some(conventions) = conventions { p { (conventions) } }
        }
    }
}

fn of_group(group: &Group<'_>) -> Vec<String> {
    let first = group.first();
    vec![
        group.set().to_owned(),
        group.name(),
        first.options.preset.to_string(),
        first.metrics.steps.to_string(),
        group.runs.len().to_string(),
    ]
}

fn charts(plots: &[Plot]) -> Markup {
    html! { div.charts { @for plot in plots { (plot.chart.figure(&plot.caption)) } } }
}

fn section(title: &str, content: Markup) -> Markup {
    html! { section { h2 { (title) } (content) } }
}
