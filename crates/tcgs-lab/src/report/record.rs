//! What a report keeps of a finished run, of a made scene's renders, and the key by which both are found again.

use serde::{Deserialize, Serialize};
use tcgs_codec::domain::{Digest, JobMetrics, Phase, Progress, SceneFormat, TrainOptions, series_bucket};

use super::machine::Machine;

/// A finished run.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct RunRecord {
    /// Name of the set.
    pub set: String,
    /// Digest of its content.
    pub dataset: Digest,
    /// The model with its switched parts, without a weight.
    pub model: String,
    pub options: TrainOptions,
    /// The adapter that was asked for.
    pub adapter: String,
    /// When the process began that made it; runs of one process can be compared in time.
    pub session: String,
    /// The machine before and after.
    pub machine: [Machine; 2],
    /// Width and height of its first held-out view.
    pub view_size: Option<[u32; 2]>,
    /// The figures of the written file.
    pub metrics: JobMetrics,
    /// The course of training.
    pub series: Vec<SeriesSample>,
    /// Seconds of decoding the file again, in the order of the tries.
    #[serde(default)]
    pub decode_seconds: Vec<f64>,
    /// Seconds of rendering each held-out view, as the first pass over them took.
    #[serde(default)]
    pub render_seconds: Option<f64>,
    /// Mean absolute difference of the high bands of the Haar transform of held-out views.
    #[serde(default)]
    pub high_band: Option<f64>,
    /// Exports of the scene to formats of plain Gaussians.
    #[serde(default)]
    pub exports: Vec<ExportRecord>,
    /// The same scene in other programs' formats.
    #[serde(default)]
    pub external_formats: Vec<ExternalFile>,
}

/// An export and what it costs.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ExportRecord {
    pub format: SceneFormat,
    /// Its size.
    pub bytes: u64,
    pub gaussians: u64,
    /// Held-out PSNR, in dB.
    pub psnr: Option<f64>,
    /// PSNR of its pictures against those of the source, in dB.
    pub psnr_to_source: f64,
}

/// A point of a run's course.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct SeriesSample {
    /// Steps done.
    pub step: u64,
    /// Seconds since training began.
    pub seconds: f64,
    /// PSNR of the training views just seen, mean of recent steps, in dB.
    pub psnr: Option<f64>,
    /// Their SSIM.
    #[serde(default)]
    pub ssim: Option<f64>,
    /// Estimated bytes of the file.
    pub bytes: Option<u64>,
}

/// Identity of a run: what has to be equal for a kept run to stand for a wanted one.
#[derive(Debug, Clone, Copy)]
pub struct RunKey<'a> {
    pub set: &'a str,
    pub dataset: Digest,
    pub model: &'a str,
    pub options: &'a TrainOptions,
    pub adapter: &'a str,
}

impl RunRecord {
    /// Whether it is the run that `key` asks for.
    pub fn is(&self, key: &RunKey<'_>) -> bool {
        self.set == key.set
            && self.dataset == key.dataset
            && self.model == key.model
            && self.options == *key.options
            && self.adapter == key.adapter
    }

    /// The least of the decoding times, which other work on the machine disturbs least.
    pub fn least_decode_seconds(&self) -> f64 {
        self.decode_seconds.iter().copied().fold(self.metrics.seconds.decode, f64::min)
    }

    /// Seconds of training until recent training views had a mean PSNR of `level` dB; `None` if they never had.
    pub fn seconds_to(&self, level: f64) -> Option<f64> {
        let reached = |sample: &&SeriesSample| sample.psnr.is_some_and(|psnr| psnr >= level);
        self.series.iter().find(reached).map(|sample| sample.seconds)
    }
}

/// Collects the course of a run from its reports.
#[derive(Debug, Default)]
pub struct Course {
    started: Option<f64>,
    last: Option<u32>,
    samples: Vec<SeriesSample>,
}

impl Course {
    /// Adds a report of training; replaces the one before if it is in the same thousandth of the run.
    pub fn add(&mut self, phase: Phase, progress: &Progress) {
        if phase != Phase::Train {
            return;
        }
        let started = *self.started.get_or_insert(progress.elapsed_seconds);
        if progress.step == 0 {
            return;
        }
        let bucket = series_bucket(progress);
        if self.last == Some(bucket) {
            self.samples.pop();
        }
        self.last = Some(bucket);
        self.samples.push(SeriesSample {
            step: progress.step,
            seconds: progress.elapsed_seconds - started,
            psnr: progress.psnr,
            ssim: progress.ssim,
            bytes: progress.bytes,
        });
    }

    pub fn samples(self) -> Vec<SeriesSample> {
        self.samples
    }
}

/// A file in another program's format, and its quality.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ExternalFile {
    /// Name of the format.
    pub format: String,
    /// Bytes of the file.
    pub bytes: u64,
    /// Held-out PSNR of what it decodes to, in dB.
    pub psnr: Option<f64>,
    /// Held-out SSIM.
    pub ssim: Option<f64>,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_course_begins_with_training_and_keeps_the_latest_of_each_part() {
        let mut course = Course::default();
        let report = |step, elapsed_seconds| Progress {
            step,
            total: 10_000,
            elapsed_seconds,
            psnr: Some(step as f64),
            ..Progress::default()
        };
        course.add(Phase::Ingest, &report(0, 1.0));
        course.add(Phase::Train, &report(0, 3.0));
        for step in 1..=10_000 {
            course.add(Phase::Train, &report(step, 3.0 + step as f64));
        }
        course.add(Phase::Encode, &report(10_000, 20_000.0));
        let samples = course.samples();
        assert_eq!(samples.len(), 1000);
        assert_eq!((samples[0].step, samples[999].step), (10, 10_000));
        assert_eq!(samples[999].seconds, 10_000.0);
    }
}
