//! Color corrections of photographs (METHOD.md §2.11): each training photograph has an affine one, which the loss sees the render
//! through. It is learnt with the scene and is part of no file.

mod corrections;
mod trial;

pub use corrections::ColorCorrections;
pub(super) use trial::{ShortRun, Trial, choose};

use super::{Decay, DecayShape};

/// The largest and the smallest first learning rate.
const FIRST_RATES: [f64; 2] = [0.01, 0.1];

/// The sum of a photograph's learning rates if all were the first one.
const REACH: f64 = 3.0;

/// The step of a photograph's correction.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Learning {
    /// Index of the photograph.
    pub photograph: usize,
    /// How often it was trained on, this time included.
    pub visit: u32,
    /// Of Adam.
    pub learning_rate: f64,
}

impl Learning {
    /// The step of `photograph` in step `number`, from 1, of a run of `steps` steps over `photographs` photographs, which takes all of
    /// them before it takes one again.
    pub(super) fn at(number: u32, steps: u32, photograph: usize, photographs: usize) -> Self {
        let photographs = u32::try_from(photographs.max(1)).unwrap_or(u32::MAX);
        let visit = number.saturating_sub(1) / photographs + 1;
        let rates = learning_rates(f64::from(steps) / f64::from(photographs));
        Self { photograph, visit, learning_rate: rates.at(f64::from(number) / f64::from(steps)) }
    }
}

/// The learning rate where a photograph is trained on `visits` times. Adam moves a parameter by at most the sum of its learning rates,
/// so the fewer visits, the larger they are.
fn learning_rates(visits: f64) -> Decay {
    let [least, most] = FIRST_RATES;
    let start = (REACH / visits).clamp(least, most);
    Decay { start, end: 0.1 * start, shape: DecayShape::Quadratic }
}

#[cfg(test)]
mod tests;
#[cfg(test)]
pub(super) use tests::distance_of_mean;
