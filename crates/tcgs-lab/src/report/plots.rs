//! The charts of a report: quality against time and size, and decoding against size.

use tcgs_engine::{
    eval::Estimate,
    plot::{Chart, Scale, Series},
};

use super::{
    record::{RunRecord, SeriesSample},
    summary::Group,
    sweep::SweepRecord,
};

/// A chart with the name of its file and what is said below it.
#[derive(Debug)]
pub struct Plot {
    /// Name of the SVG file without its extension.
    pub file: String,
    pub caption: String,
    pub chart: Chart,
}

/// The charts of a report by section.
#[derive(Debug)]
pub struct Plots {
    pub time: Vec<Plot>,
    pub bytes: Vec<Plot>,
    pub decoding: Vec<Plot>,
    pub rendering: Vec<Plot>,
}

impl Plots {
    /// PSNR against size of every set in one picture; `None` without runs.
    pub fn quality(&self) -> Option<String> {
        let charts: Vec<&Chart> = self.bytes.iter().map(|plot| &plot.chart).collect();
        Chart::sheet("PSNR of held-out views against the size of the file, by set", &charts)
    }

    pub fn all(&self) -> impl Iterator<Item = &Plot> {
        [&self.time, &self.bytes, &self.decoding, &self.rendering].into_iter().flatten()
    }
}

/// Every chart: those of runs by set, and that of made scenes.
pub fn all(groups: &[Group<'_>], sets: &[&str], sweeps: &[SweepRecord]) -> Plots {
    let each = |of: fn(&[&Group<'_>], &str) -> Vec<Plot>| -> Vec<Plot> {
        let of_set = |set: &&str| {
            let groups: Vec<&Group<'_>> = groups.iter().filter(|group| group.set() == *set).collect();
            of(&groups, set)
        };
        sets.iter().flat_map(of_set).filter(|plot| !plot.chart.series.is_empty()).collect()
    };
    Plots {
        time: each(against_time),
        bytes: each(against_bytes),
        decoding: each(decoding),
        rendering: rendering(sweeps),
    }
}

/// Milliseconds against error of made scenes, and against the number of Gaussians.
fn rendering(sweeps: &[SweepRecord]) -> Vec<Plot> {
    if sweeps.is_empty() {
        return Vec::new();
    }
    let mut by_variant: Vec<Series> = Vec::new();
    let mut by_side: Vec<Series> = Vec::new();
    let add = |all: &mut Vec<Series>, name: &str, is_scattered, point, label| {
        let place = all.iter().position(|series| series.name == name).unwrap_or_else(|| {
            all.push(Series { name: name.to_owned(), is_scattered, ..Series::default() });
            all.len() - 1
        });
        all[place].points.push(point);
        all[place].labels.push(label);
    };
    for sweep in sweeps {
        let label = format!("{} Gaussians, {} px", sweep.gaussians, sweep.side);
        for variant in &sweep.variants {
            let point = (variant.fastest_ms(), variant.error.rmse);
            add(&mut by_variant, &variant.name, true, point, label.clone());
        }
        if let Some(own) = sweep.variants.first() {
            let point = (sweep.gaussians as f64, own.fastest_ms());
            add(&mut by_side, &format!("{0} x {0} pixels", sweep.side), false, point, label);
        }
    }
    by_side.iter_mut().for_each(|series| series.points.sort_by(|a, b| a.0.total_cmp(&b.0)));
    let chart = |title: &str, x: &str, y: &str, series| Chart {
        title: title.to_owned(),
        x: x.to_owned(),
        y: y.to_owned(),
        x_scale: Scale::Log,
        y_scale: Scale::Log,
        series,
    };
    vec![
        Plot {
            file: "render-error".to_owned(),
            caption: "Made scenes; the least of several renders of each variant, all variants in turn, against the f64 reference."
                .to_owned(),
            chart: chart("Rendering: time against error", "ms a view", "rms error of colors", by_variant),
        },
        Plot {
            file: "render-gaussians".to_owned(),
            caption: "The adapter's own kernels.".to_owned(),
            chart: chart("Rendering: time against Gaussians", "Gaussians", "ms a view", by_side),
        },
    ]
}

/// A set's name in the name of a file.
fn file(kind: &str, set: &str) -> String {
    let is_safe = |c: char| c.is_ascii_alphanumeric() || c == '-' || c == '_';
    format!("{kind}-{}", set.chars().map(|c| if is_safe(c) { c } else { '_' }).collect::<String>())
}

/// A line for each run: quality of the training views just seen.
fn against_time(groups: &[&Group<'_>], set: &str) -> Vec<Plot> {
    let chart = |title: &str, y: &str, kind: &str, figure: fn(&SeriesSample) -> Option<f64>| {
        let line = |group: &&Group<'_>, run: &&RunRecord| {
            let points = run.series.iter().filter_map(|point| Some((point.seconds, figure(point)?)));
            Series { name: group.name(), points: points.collect(), ..Series::default() }
        };
        let series = groups
            .iter()
            .flat_map(|group| group.runs.iter().map(move |run| line(group, run)))
            .filter(|series| !series.points.is_empty())
            .collect();
        Plot {
            file: file(kind, set),
            caption: "One line for each seed: training views just seen, mean of recent steps. Shorter schedules decay sooner."
                .to_owned(),
            chart: Chart {
                title: format!("{set}: {title} against training time"),
                x: "seconds of training".to_owned(),
                y: y.to_owned(),
                series,
                ..Chart::default()
            },
        }
    };
    vec![
        chart("PSNR", "dB", "psnr-seconds", |point| point.psnr),
        chart("SSIM", "SSIM", "ssim-seconds", |point| point.ssim),
    ]
}

/// A point for each group, joined by weight; other programs' formats beside them.
fn against_bytes(groups: &[&Group<'_>], set: &str) -> Vec<Plot> {
    let mut series: Vec<Series> = Vec::new();
    let mut add = |name: String, x: Option<Estimate>, y: Option<Estimate>, label: String, scattered| {
        let (Some(x), Some(y)) = (x, y) else { return };
        let place = series.iter().position(|series| series.name == name).unwrap_or_else(|| {
            series.push(Series { name, is_scattered: scattered, ..Series::default() });
            series.len() - 1
        });
        let series = &mut series[place];
        series.points.push((x.mean, y.mean));
        series.spreads.push(y.half_width);
        series.labels.push(label);
    };
    for group in groups {
        let bytes = group.estimate(|run| Some(run.metrics.bytes.total as f64));
        let psnr = group.estimate(|run| run.metrics.test.psnr);
        add(group.curve_name(), bytes, psnr, group.name(), false);
        for file in &group.first().external_formats {
            let of = |run: &RunRecord| {
                run.external_formats.iter().find(|other| other.format == file.format).cloned()
            };
            let bytes = group.estimate(|run| Some(of(run)?.bytes as f64));
            let psnr = group.estimate(|run| of(run)?.psnr);
            add(format!("{} in other formats", group.family()), bytes, psnr, file.format.clone(), true);
        }
        for export in &group.first().exports {
            let of =
                |run: &RunRecord| run.exports.iter().find(|other| other.format == export.format).cloned();
            let bytes = group.estimate(|run| Some(of(run)?.bytes as f64));
            let psnr = group.estimate(|run| of(run)?.psnr);
            let label = format!("{} as {}", group.name(), export.format.name());
            add(format!("{} exported", group.family()), bytes, psnr, label, true);
        }
    }
    for one in &mut series {
        sort_by_bytes(one);
    }
    vec![Plot {
        file: file("psnr-bytes", set),
        caption: "Held-out views of the decoded files; bars are 95 % intervals over seeds. Lines join the weights of one schedule.".to_owned(),
        chart: Chart {
            title: format!("{set}: PSNR against size"),
            x: "bytes".to_owned(),
            y: "dB".to_owned(),
            x_scale: Scale::Log,
            series,
            ..Chart::default()
        },
    }]
}

fn sort_by_bytes(series: &mut Series) {
    let mut order: Vec<usize> = (0..series.points.len()).collect();
    order.sort_by(|a, b| series.points[*a].0.total_cmp(&series.points[*b].0));
    series.points = order.iter().map(|at| series.points[*at]).collect();
    series.spreads = order.iter().map(|at| series.spreads[*at]).collect();
    series.labels = order.iter().map(|at| series.labels[*at].clone()).collect();
}

/// Seconds of decoding against bytes, a point for each run.
fn decoding(groups: &[&Group<'_>], set: &str) -> Vec<Plot> {
    let mut series: Vec<Series> = Vec::new();
    for group in groups {
        let model = group.model();
        let place = series.iter().position(|series| series.name == model).unwrap_or_else(|| {
            series.push(Series { name: model.clone(), is_scattered: true, ..Series::default() });
            series.len() - 1
        });
        for run in &group.runs {
            series[place].points.push((run.metrics.bytes.total as f64, run.least_decode_seconds()));
            series[place].labels.push(group.name());
        }
    }
    vec![Plot {
        file: file("decode-bytes", set),
        caption: "The least of several readings of each file, from its bytes to a scene in memory."
            .to_owned(),
        chart: Chart {
            title: format!("{set}: decoding against size"),
            x: "bytes".to_owned(),
            y: "seconds".to_owned(),
            x_scale: Scale::Log,
            y_scale: Scale::Log,
            series,
        },
    }]
}
