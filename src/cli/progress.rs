//! Progress on standard error: a bar on a terminal, lines elsewhere.

use std::{
    io::{self, IsTerminal},
    time::Duration,
};

use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};
use tcgs::domain::{Phase, Progress};

use super::notice::notice;

/// Seconds of the run between two lines of one phase.
const SECONDS_BETWEEN_LINES: f64 = 5.0;

/// Shows progress.
pub(crate) enum Display {
    /// On a terminal.
    Bar(ProgressBar),
    /// In a log: the phase and the time of the last line.
    Lines {
        /// Phase and time of the last line.
        last: Option<(Phase, f64)>,
    },
}

impl Display {
    /// A display that suits standard error.
    pub(crate) fn new() -> Self {
        if !io::stderr().is_terminal() {
            return Self::Lines { last: None };
        }
        let bar = ProgressBar::with_draw_target(Some(0), ProgressDrawTarget::stderr());
        bar.enable_steady_tick(Duration::from_millis(500));
        Self::Bar(bar)
    }

    /// Shows one report.
    pub(crate) fn show(&mut self, phase: Phase, progress: &Progress) {
        match self {
            Self::Bar(bar) => {
                let counts = counts(phase, progress);
                bar.set_style(style(counts.is_some()));
                bar.set_prefix(phase.name());
                if let Some((done, total)) = counts {
                    bar.set_length(total);
                    bar.set_position(done);
                }
                bar.set_message(headline(phase, progress).join("  "));
            }
            Self::Lines { last } => {
                if is_due(*last, phase, progress) {
                    *last = Some((phase, progress.elapsed_seconds));
                    notice(line(phase, progress));
                }
            }
        }
    }

    /// Restores the terminal.
    pub(crate) fn finish(self) {
        if let Self::Bar(bar) = self {
            bar.finish_and_clear();
        }
    }
}

/// Of a phase with counts, or of one whose end is not known.
fn style(is_counted: bool) -> ProgressStyle {
    let template =
        if is_counted { "{prefix} {bar:10} {pos}/{len}  {wide_msg}" } else { "{prefix} {spinner}" };
    ProgressStyle::with_template(template).expect("the template is well formed").progress_chars("=>-")
}

fn is_due(last: Option<(Phase, f64)>, phase: Phase, progress: &Progress) -> bool {
    last.is_none_or(|(shown, at)| shown != phase || progress.elapsed_seconds - at >= SECONDS_BETWEEN_LINES)
}

fn line(phase: Phase, progress: &Progress) -> String {
    let mut text = format!("{:>6.1}s {}", progress.elapsed_seconds, phase.name());
    if let Some((done, total)) = counts(phase, progress) {
        text.push_str(&format!(" {done}/{total}"));
    }
    let figures = figures(phase, progress);
    if !figures.is_empty() {
        text.push_str("  ");
        text.push_str(&figures);
    }
    text
}

/// Steps that are done and all steps; of the search for cameras, photographs or pairs. Only training makes steps: what other phases
/// report of them is left over from it.
fn counts(phase: Phase, progress: &Progress) -> Option<(u64, u64)> {
    let steps = || (phase == Phase::Train).then_some((progress.step, progress.total));
    progress.poses.map(|poses| (poses.done, poses.total)).or_else(steps).filter(|(_, total)| *total > 0)
}

/// The stage of the search for cameras, or the time left, speed, quality and size, as far as known: what fits beside a bar on 80 columns.
fn headline(phase: Phase, progress: &Progress) -> Vec<String> {
    let mut parts = Vec::new();
    if let Some(poses) = progress.poses {
        parts.push(poses.stage.name().to_owned());
        parts.extend(poses.reprojection_error.map(|error| format!("error {error:.2} px")));
    }
    if phase != Phase::Train {
        return parts;
    }
    if let Some(eta) = progress.eta_seconds {
        let seconds = eta.max(0.0).round() as u64;
        parts.push(format!("ETA {}:{:02}", seconds / 60, seconds % 60));
    }
    parts.extend(progress.steps_per_second.map(|speed| format!("{speed:.1} steps/s")));
    parts.extend(progress.psnr.map(|psnr| format!("{psnr:.2} dB")));
    parts.extend(progress.bytes.map(|bytes| format!("{:.0} kB", bytes as f64 / 1e3)));
    parts
}

/// The headline, then loss and counts.
fn figures(phase: Phase, progress: &Progress) -> String {
    let mut parts = headline(phase, progress);
    if phase != Phase::Train {
        return parts.join("  ");
    }
    parts.extend(progress.loss.map(|loss| format!("loss {loss:.4}")));
    if progress.anchors > 0 {
        parts.push(format!("anchors {}", progress.anchors));
    }
    if progress.gaussians > 0 {
        parts.push(format!("Gaussians {}", progress.gaussians));
    }
    parts.join("  ")
}

#[cfg(test)]
mod tests {
    use tcgs::domain::{PoseProgress, PoseStage};

    use super::*;

    fn report() -> Progress {
        Progress {
            step: 120,
            total: 1500,
            elapsed_seconds: 14.25,
            eta_seconds: Some(163.4),
            steps_per_second: Some(8.45),
            anchors: 5120,
            gaussians: 20_480,
            loss: Some(0.041_23),
            psnr: Some(24.317),
            ssim: None,
            bytes: Some(152_340),
            poses: None,
            preview: None,
            checkpoint_step: 0,
        }
    }

    #[test]
    fn a_line_holds_every_figure_that_is_known_and_no_other() {
        assert_eq!(
            line(Phase::Train, &report()),
            "  14.2s train 120/1500  ETA 2:43  8.4 steps/s  24.32 dB  152 kB  loss 0.0412  anchors 5120  Gaussians 20480"
        );
        assert_eq!(line(Phase::Ingest, &Progress::default()), "   0.0s ingest");
    }

    #[test]
    fn phases_after_training_repeat_none_of_its_figures() {
        for phase in [Phase::Encode, Phase::Evaluate, Phase::Publish] {
            assert_eq!(line(phase, &report()), format!("  14.2s {}", phase.name()));
        }
        let poses =
            PoseProgress { stage: PoseStage::Matches, done: 3, total: 10, reprojection_error: Some(0.5) };
        let searching = Progress { poses: Some(poses), ..Progress::default() };
        assert_eq!(line(Phase::Poses, &searching), "   0.0s poses 3/10  matches  error 0.50 px");
    }

    #[test]
    fn the_headline_of_a_long_run_fits_beside_its_bar() {
        let long = Progress {
            step: 29_999,
            total: 30_000,
            eta_seconds: Some(7_199.0),
            steps_per_second: Some(123.4),
            psnr: Some(34.567),
            bytes: Some(12_345_678),
            ..report()
        };
        let beside = "evaluate ".len() + 11 + "29999/30000  ".len();
        assert_eq!(headline(Phase::Train, &long).join("  "), "ETA 119:59  123.4 steps/s  34.57 dB  12346 kB");
        assert!(beside + headline(Phase::Train, &long).join("  ").len() <= 80);
    }

    #[test]
    fn lines_come_with_each_phase_and_otherwise_now_and_then() {
        assert!(is_due(None, Phase::Train, &report()));
        assert!(is_due(Some((Phase::Ingest, 14.0)), Phase::Train, &report()));
        assert!(!is_due(Some((Phase::Train, 14.0)), Phase::Train, &report()));
        assert!(is_due(Some((Phase::Train, 9.0)), Phase::Train, &report()));
    }
}
