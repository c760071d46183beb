//! Steers the weight of the rate term towards a file of a promised size.
//!
//! The best file of a size is the one that a constant weight gives: so the first estimate makes a guess of that weight, and an
//! integral of the errors after it corrects the guess, slowly, since what a weight takes it takes over many steps. What it sees is
//! the logarithm of the size to be expected over the size aimed at. The weight never falls below the run's own: a promise makes
//! bytes dearer, never cheaper. What always holds: the weight is a function of the estimates and the steps that they came
//! at, and of nothing else.

use std::ops::RangeInclusive;

use serde::{Deserialize, Serialize};

/// Size aimed at, as a share of the promised one: the file is made to fit exactly at the end, which is easier from below.
const TARGET_SHARE: f64 = 0.98;

/// Least size aimed at, over the bytes that no weight changes: what is below is for the end of the run, which drops Gaussians.
/// So all promises that are smaller are steered alike, and the smallest size that one of them is told can be reached by
/// the next.
const MIN_TARGET: f64 = 1.25;

/// Growth of the logarithm of the weight for each unit of error at the first estimate: files of real scenes shrink with
/// about the fourth root of a weight that is there from then on.
const INITIAL_GAIN: f64 = 4.0;

/// The same for each step after it, and over all of them at most: a weight takes a hundred steps and more to show what it does,
/// so in short runs a faster correction goes too far before that is seen.
const INTEGRAL_GAIN_PER_STEP: f64 = 0.024;
const MAX_INTEGRAL_GAIN: f64 = 18.0;

/// Error beyond which a larger one moves no faster: estimates jump when the model does.
const MAX_ERROR: f64 = 0.7;

/// Share of the steps at the begin in which nothing is steered yet: estimates are still of a context model that knows nothing.
const SETTLING: f64 = 0.2;

/// What a file has of an estimate, up to a share of the steered steps: masks first have to part what is worth its bytes from
/// what is not, then what they mask has to be left out. Measured on real scenes, 0.45 to 0.65 and 0.6 to 0.9.
const REMAINING: [(f64, f64); 2] = [(0.45, 0.55), (0.77, 0.8)];

/// How many times the run's own weight it may become.
const MAX_RATIO: f64 = 64.0;

/// What a controller remembers; as bits, since numbers do not always survive JSON.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RateControlState {
    /// Natural logarithm of the weight over the run's own.
    log_ratio: u64,
    /// The step of the last estimate; 0 before any.
    step: u32,
}

/// A controller of the weight.
#[derive(Debug, Clone, PartialEq)]
pub struct RateControl {
    base: f64,
    target: f64,
    window: RangeInclusive<u32>,
    log_ratio: f64,
    step: u32,
}

impl RateControl {
    /// A controller that begins at the run's own weight `base` and steers in the steps of `window`, but for its
    /// first fifth, towards a file of no more than `max_bytes`.
    #[must_use]
    pub fn new(base: f64, max_bytes: u64, window: RangeInclusive<u32>) -> Self {
        let target = TARGET_SHARE * max_bytes.max(1) as f64;
        let (begin, end) = window.into_inner();
        let settled = begin + (f64::from(end.saturating_sub(begin)) * SETTLING) as u32;
        let window = settled..=end;
        Self { base, target, window, log_ratio: 0.0, step: 0 }
    }

    /// The same controller as it was when it gave `state`.
    #[must_use]
    pub fn at(self, state: RateControlState) -> Self {
        let RateControlState { log_ratio, step } = state;
        let log_ratio = Some(f64::from_bits(log_ratio)).filter(|value| value.is_finite()).unwrap_or(0.0);
        Self { log_ratio: log_ratio.clamp(0.0, MAX_RATIO.ln()), step, ..self }
    }

    /// What it remembers.
    #[must_use]
    pub fn state(&self) -> RateControlState {
        RateControlState { log_ratio: self.log_ratio.to_bits(), step: self.step }
    }

    /// The weight from now on.
    #[must_use]
    pub fn lambda(&self) -> f64 {
        self.base * self.log_ratio.exp()
    }

    /// Takes the estimate of the file's bytes after `step`, `fixed` of which no weight changes. Estimates outside the steered steps, or that are no numbers, change
    /// nothing.
    pub fn observe(&mut self, step: u32, bytes: f64, fixed: f64) {
        let is_size = bytes.is_finite() && bytes > 0.0 && fixed.is_finite() && fixed >= 0.0;
        if !self.window.contains(&step) || step <= self.step || !is_size {
            return;
        }
        let target = self.target.max(MIN_TARGET * fixed);
        let (begin, end) = (*self.window.start(), *self.window.end());
        let length = f64::from(end - begin).max(1.0);
        let error = (bytes * remaining_share(f64::from(step - begin) / length) / target)
            .ln()
            .clamp(-MAX_ERROR, MAX_ERROR);
        let gain = if self.step < begin {
            INITIAL_GAIN
        } else {
            INTEGRAL_GAIN_PER_STEP.min(MAX_INTEGRAL_GAIN / length) * f64::from(step - self.step)
        };
        self.log_ratio = (self.log_ratio + gain * error).clamp(0.0, MAX_RATIO.ln());
        self.step = step;
    }
}

/// What a file has of an estimate that comes after a share `done` of the steered steps.
fn remaining_share(done: f64) -> f64 {
    REMAINING.iter().find(|(until, _)| done < *until).map_or(1.0, |(_, left)| *left)
}

#[cfg(test)]
mod tests {
    use super::*;

    const WINDOW: RangeInclusive<u32> = 1000..=3000;

    /// A scene in training: what its file would take follows the weight with a delay.
    #[derive(Clone)]
    struct SimulatedFile {
        /// Bytes at the run's own weight, beside those that no weight changes.
        free: f64,
        fixed: f64,
        /// By how much the logarithm of the size falls for each unit of the weight's.
        slope: f64,
        /// Steps in which a change does most of what it does.
        delay: f64,
        now: f64,
        /// Share of what the weight took that does not come back.
        lost: f64,
        lowest: f64,
        /// What the file has of estimates before masks part what is worth its bytes, and before what they mask is left out.
        left: [f64; 2],
    }

    impl SimulatedFile {
        fn new(slope: f64, delay: f64) -> Self {
            Self {
                free: 1e6,
                fixed: 2e4,
                slope,
                delay,
                now: 0.0,
                lost: 0.0,
                lowest: 1.0,
                left: REMAINING.map(|(_, left)| left),
            }
        }

        fn step(&mut self, ratio: f64) {
            self.now += (ratio.ln() - self.now) / self.delay;
            self.lowest = self.lowest.min((-self.slope * self.lost * self.now).exp());
        }

        fn bytes(&self) -> f64 {
            let taken = (-self.slope * (1.0 - self.lost) * self.now).exp() * self.lowest;
            self.fixed + self.free * taken
        }

        /// What is estimated after a share `done` of the steered steps.
        fn estimate(&self, done: f64) -> f64 {
            let [first, second] = REMAINING.map(|(until, _)| until);
            let left = if done < first {
                self.left[0]
            } else if done < second {
                self.left[1]
            } else {
                1.0
            };
            self.bytes() / left
        }
    }

    fn steer(
        control: &mut RateControl,
        file: &mut SimulatedFile,
        steps: RangeInclusive<u32>,
        every: u32,
    ) -> Vec<f64> {
        let mut seen = Vec::new();
        for step in steps {
            file.step(control.lambda() / control.base);
            if step.is_multiple_of(every) {
                // Estimates are of a sample of the anchors, so they are never quite right.
                let noise = 1.0 + 0.02 * (f64::from(step) * 0.7).sin();
                let (begin, end) = (f64::from(*control.window.start()), f64::from(*control.window.end()));
                let done = (f64::from(step) - begin) / (end - begin);
                control.observe(step, file.estimate(done) * noise, file.fixed);
                seen.push(file.bytes());
            }
        }
        seen
    }

    /// By which power of the weight files of real scenes shrink.
    const SLOPES: [f64; 3] = [0.2, 0.27, 0.35];

    #[test]
    fn files_come_to_the_promised_size_whatever_the_scene() {
        for slope in SLOPES {
            for delay in [20.0, 80.0, 200.0] {
                for budget in [700_000.0, 500_000.0, 420_000.0] {
                    let mut file = SimulatedFile::new(slope, delay);
                    let mut control = RateControl::new(1e-3, budget as u64, WINDOW);
                    let seen = steer(&mut control, &mut file, 1..=3000, 10);
                    let (last, least) =
                        (file.bytes() / budget, seen.iter().copied().fold(f64::INFINITY, f64::min));
                    let place = format!("slope {slope}, delay {delay}, {budget} bytes");
                    let reached = (budget / file.free).powf(-slope.recip()) < MAX_RATIO;
                    assert!((0.95..if reached { 1.04 } else { 1.1 }).contains(&last), "{place}: {last}");
                    assert!(least > 0.75 * budget, "{place}: falls to {least}");
                }
            }
        }
    }

    #[test]
    fn estimates_that_fall_more_or_less_than_usual_do_not_cost_a_short_run_its_bytes() {
        for slope in SLOPES {
            for left in [[0.45, 0.7], [0.65, 0.9]] {
                for lost in [0.5, 0.9] {
                    let mut file = SimulatedFile { lost, left, ..SimulatedFile::new(slope, 30.0) };
                    let mut control = RateControl::new(1e-3, 600_000, 100..=255);
                    steer(&mut control, &mut file, 1..=255, 10);
                    let used = file.bytes() / 6e5;
                    let place = format!("slope {slope}, {left:?} left, {lost} lost");
                    assert!((0.65..1.2).contains(&used), "{place}: {used} of the promise is used");
                }
            }
        }
    }

    #[test]
    fn runs_of_any_length_are_steered_alike() {
        let end = |length: u32, every: u32| {
            let mut file = SimulatedFile::new(0.5, f64::from(length) * 0.05);
            let mut control = RateControl::new(1e-3, 400_000, 1..=length);
            steer(&mut control, &mut file, 1..=length, every);
            file.bytes()
        };
        assert!((end(200, 10) / end(20_000, 10) - 1.0).abs() < 0.1);
    }

    #[test]
    fn a_promise_that_is_kept_anyway_leaves_the_weight_alone() {
        let mut file = SimulatedFile::new(0.5, 80.0);
        let mut control = RateControl::new(2e-3, 5_000_000, WINDOW);
        steer(&mut control, &mut file, 1..=3000, 10);
        assert_eq!(control.lambda(), 2e-3);
    }

    #[test]
    fn an_impossible_promise_stops_at_a_bound() {
        let mut file = SimulatedFile::new(0.5, 80.0);
        let mut control = RateControl::new(1e-3, 1, WINDOW);
        steer(&mut control, &mut file, 1..=3000, 10);
        assert!((control.lambda() / 1e-3 - MAX_RATIO).abs() < 1e-6 * MAX_RATIO);
    }

    #[test]
    fn promises_below_what_a_weight_can_do_are_steered_alike() {
        let end = |max_bytes| {
            let mut file = SimulatedFile::new(0.8, 80.0);
            let mut control = RateControl::new(1e-3, max_bytes, WINDOW);
            steer(&mut control, &mut file, 1..=3000, 10);
            control.lambda().to_bits()
        };
        assert_eq!(end(100), end(20_000), "20 000 bytes are fixed");
        assert_ne!(end(100), end(200_000));
    }

    #[test]
    fn estimates_that_are_none_or_out_of_time_change_nothing() {
        let mut control = RateControl::new(1e-3, 1000, WINDOW);
        for (step, bytes) in
            [(999, 1e9), (3001, 1e9), (1500, f64::NAN), (1500, 0.0), (1500, -5.0), (1500, f64::INFINITY)]
        {
            control.observe(step, bytes, 0.0);
        }
        control.observe(1500, 1e9, f64::NAN);
        assert_eq!(control, RateControl::new(1e-3, 1000, WINDOW));
        control.observe(1500, 1e9, 0.0);
        let once = control.clone();
        control.observe(1500, 1e9, 0.0);
        control.observe(1400, 1e9, 0.0);
        assert_eq!(control, once, "a step counts once, and time goes one way");
    }

    #[test]
    fn a_controller_that_goes_on_from_any_state_takes_the_same_way() {
        let fresh = || RateControl::new(1e-3, 300_000, WINDOW);
        let (mut whole, mut file) = (fresh(), SimulatedFile::new(0.5, 80.0));
        steer(&mut whole, &mut file, 1..=3000, 10);
        for stop in [1, 999, 1000, 1005, 1010, 2000, 2999] {
            let (mut first, mut file) = (fresh(), SimulatedFile::new(0.5, 80.0));
            steer(&mut first, &mut file, 1..=stop, 10);
            let kept = serde_json::to_string(&first.state()).expect("JSON");
            let mut second = fresh().at(serde_json::from_str(&kept).expect("a state"));
            assert_eq!(second, first);
            steer(&mut second, &mut file, stop + 1..=3000, 10);
            assert_eq!(second.lambda().to_bits(), whole.lambda().to_bits(), "stopped after {stop}");
        }
    }

    #[test]
    fn a_state_that_no_controller_gives_does_no_harm() {
        for bits in [f64::NAN, f64::INFINITY, -1e300, 1e300].map(f64::to_bits) {
            let state = RateControlState { log_ratio: bits, step: 1500 };
            let mut control = RateControl::new(1e-3, 1000, WINDOW).at(state);
            control.observe(1600, 900.0, 0.0);
            assert!((1e-3..=MAX_RATIO * 1.001e-3).contains(&control.lambda()));
        }
    }
}
