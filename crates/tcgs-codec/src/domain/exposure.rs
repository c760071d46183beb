//! Color corrections of photographs: whether a run learns them, and what it decided that by.

use serde::{Deserialize, Serialize};

use super::choice::named_choice;

named_choice! {
    /// Whether each photograph has an affine color correction of its own, learnt with the scene (METHOD.md §2.11).
    #[derive(Default)]
    pub enum Exposure {
        /// On for photographs if training views that are set aside gain by it.
        #[default]
        Auto = "auto",
        /// Always.
        On = "on",
        /// Never.
        Off = "off",
    }
}

/// How `exposure=auto` was decided: by training views that a short run was not trained on.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct ExposureTrial {
    /// Training views set aside, without those of which a mask hides one half.
    pub views: usize,
    /// Mean PSNR in dB over their right halves that corrections fitted to their left halves gain over a common one.
    pub gain: f64,
    /// The gain in dB from which corrections are on.
    pub needed: f64,
}

/// Whether a run learnt color corrections, and why.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub struct ExposureChoice {
    /// Whether it did.
    pub corrected: bool,
    /// Null if the option decided, or the dataset and the run do not suit a trial.
    pub trial: Option<ExposureTrial>,
}

impl ExposureChoice {
    /// Never: what runs of versions without corrections did.
    pub const OFF: Self = Self { corrected: false, trial: None };
    /// As the option says.
    pub const ON: Self = Self { corrected: true, trial: None };

    /// The choice that a trial makes.
    #[must_use]
    pub fn by(trial: ExposureTrial) -> Self {
        Self { corrected: trial.gain >= trial.needed, trial: Some(trial) }
    }

    /// The reason, for people.
    #[must_use]
    pub fn because(&self) -> String {
        match self.trial {
            Some(ExposureTrial { views, gain, needed }) => {
                format!("{views} training views set aside gain {gain:.2} dB by it; {needed} dB are needed")
            }
            None if self.corrected => "the option".to_owned(),
            None => "the option, or nothing to try it on".to_owned(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn corrections_are_on_from_the_gain_that_is_needed() {
        let trial = |gain| ExposureTrial { views: 4, gain, needed: 0.5 };
        assert!(ExposureChoice::by(trial(0.5)).corrected);
        assert!(!ExposureChoice::by(trial(0.49)).corrected);
        assert!(!ExposureChoice::by(trial(f64::NAN)).corrected);
        let because = ExposureChoice::by(trial(2.0)).because();
        assert_eq!(because, "4 training views set aside gain 2.00 dB by it; 0.5 dB are needed");
        assert_eq!(ExposureChoice::default(), ExposureChoice::OFF);
    }
}
