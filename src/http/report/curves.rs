//! Which curves a job has: quality against time and against size, and loss.

use maud::{Markup, html};

use super::history::History;
use crate::{
    domain::SeriesPoint,
    plot::{Chart, Series},
    store::JobRecord,
};

/// The section of curves.
pub(super) fn curves(record: &JobRecord, history: &History) -> Markup {
    html! {
        section #curves {
            h2 { "Curves" }
            div.charts {
                (against_time(record, history))
                (ssim(record, history))
                (against_size(record, history))
                (loss(history))
            }
        }
    }
}

fn line(name: &str, points: Vec<(f64, f64)>) -> Series {
    Series { name: name.to_owned(), points, ..Series::default() }
}

fn against_time(record: &JobRecord, history: &History) -> Markup {
    let mut training = as_measured(history.points(|point| Some(point.seconds), |point| point.psnr));
    let held_out = record.job.metrics.as_ref().and_then(|metrics| metrics.test.psnr);
    let mut held_out: Vec<(f64, f64)> = held_out.map(|psnr| (history.end, psnr)).into_iter().collect();
    let unit = TimeUnit::of(history.end);
    training.iter_mut().chain(&mut held_out).for_each(|(seconds, _)| *seconds /= unit.seconds);
    Chart {
        title: "PSNR against time".to_owned(),
        x: unit.name.to_owned(),
        y: "dB".to_owned(),
        series: vec![
            line("while training", training),
            line("held-out views, the decoded file", held_out),
        ],
        ..Chart::default()
    }
    .figure(
        "Time since the work began, measuring included. Figures while training are of the model as it was then, on up to four held-out views.",
    )
}

/// The points at which the figure was measured: reports repeat it until the next time.
fn as_measured(points: Vec<(f64, f64)>) -> Vec<(f64, f64)> {
    let mut measured: Vec<(f64, f64)> = Vec::with_capacity(points.len());
    for point in points {
        if measured.last().is_none_or(|last| last.1 != point.1) {
            measured.push(point);
        }
    }
    measured
}

fn ssim(record: &JobRecord, history: &History) -> Markup {
    let mut training = history.points(|point| Some(point.seconds), |point| point.ssim);
    let held_out = record.job.metrics.as_ref().and_then(|metrics| metrics.test.ssim);
    let mut held_out: Vec<(f64, f64)> = held_out.map(|ssim| (history.end, ssim)).into_iter().collect();
    let unit = TimeUnit::of(history.end);
    training.iter_mut().chain(&mut held_out).for_each(|(seconds, _)| *seconds /= unit.seconds);
    Chart {
        title: "SSIM against time".to_owned(),
        x: unit.name.to_owned(),
        y: "SSIM".to_owned(),
        series: vec![
            line("training views, mean of recent steps", training),
            line("held-out views, the decoded file", held_out),
        ],
        ..Chart::default()
    }
    .figure("Time as above. Figures while training are of the batches just seen.")
}

fn against_size(record: &JobRecord, history: &History) -> Markup {
    let metrics = record.job.metrics.as_ref();
    let curve = metrics.map_or(&[][..], |metrics| &metrics.rd_curve);
    let finished: Vec<(f64, f64, String)> = if curve.is_empty() {
        let point = metrics.and_then(|metrics| {
            Some((metrics.bytes.total as f64, metrics.test.psnr?, "the file".to_owned()))
        });
        point.into_iter().collect()
    } else {
        let mut points: Vec<_> = curve
            .iter()
            .filter_map(|point| Some((point.bytes as f64, point.psnr?, format!("λ = {}", point.lambda))))
            .collect();
        points.sort_by(|a, b| a.0.total_cmp(&b.0));
        points
    };
    let estimated = |point: &SeriesPoint| point.bytes.map(|bytes| bytes as f64);
    let mut training = if curve.is_empty() {
        as_measured(history.points(estimated, |point| point.psnr))
    } else {
        Vec::new()
    };
    let max = training
        .iter()
        .map(|(bytes, _)| *bytes)
        .chain(finished.iter().map(|(bytes, ..)| *bytes))
        .fold(0.0, f64::max);
    let (unit, name) = if max >= 1e6 { (1e6, "MB (10⁶ bytes)") } else { (1e3, "kB (10³ bytes)") };
    training.iter_mut().for_each(|(bytes, _)| *bytes /= unit);
    let finished_points = finished.iter().map(|(bytes, psnr, _)| (bytes / unit, *psnr)).collect();
    let labels = finished.into_iter().map(|(.., label)| label).collect();
    let caption = if curve.is_empty() {
        "While training: the size that the file would about have, and PSNR as above. The dot is the finished \
         file on the held-out views. A job with rd_curve has a curve of finished files here."
    } else {
        "Each dot is a finished file, trained with its own weight of the rate, on the held-out views."
    };
    Chart {
        title: "PSNR against size".to_owned(),
        x: name.to_owned(),
        y: "dB".to_owned(),
        series: vec![
            line("while training", training),
            Series { labels, ..line("held-out views, finished files", finished_points) },
        ],
        ..Chart::default()
    }
    .figure(caption)
}

fn loss(history: &History) -> Markup {
    let points = history.points(|point| Some(point.step as f64), |point| point.loss);
    Chart {
        title: "Loss".to_owned(),
        x: "step".to_owned(),
        y: "loss".to_owned(),
        series: vec![line("mean of recent steps", points)],
        ..Chart::default()
    }
    .figure("What the optimizer minimizes: picture, size and regularization together.")
}

/// What an axis of time is marked in.
struct TimeUnit {
    name: &'static str,
    seconds: f64,
}

impl TimeUnit {
    fn of(longest: f64) -> Self {
        match longest {
            ..=600.0 => Self { name: "seconds", seconds: 1.0 },
            ..=14_400.0 => Self { name: "minutes", seconds: 60.0 },
            _ => Self { name: "hours", seconds: 3600.0 },
        }
    }
}
