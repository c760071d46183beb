//! One step of a photograph's correction, and the mean of all.

use glam::DVec4;

use crate::train::twin::{AdamElement, adam};

/// A correction with its moments: three rows of four.
pub type CorrectionElements = [[AdamElement; 4]; 3];

/// Adam's step `visit` (from 1) of the correction of `photograph`, after which the mean of all is brought back to the identity.
pub fn correction_step(
    corrections: &mut [CorrectionElements],
    photograph: usize,
    visit: u32,
    learning_rate: f64,
    gradient: &[DVec4; 3],
) {
    for (row, gradient) in corrections[photograph].iter_mut().zip(gradient) {
        for (element, gradient) in row.iter_mut().zip(gradient.to_array()) {
            *element = adam(*element, visit, learning_rate, gradient);
        }
    }
    let count = corrections.len() as f64;
    for row in 0..3 {
        for column in 0..4 {
            let sum: f64 = corrections.iter().map(|correction| correction[row][column].value).sum();
            let away = sum / count - if row == column { 1.0 } else { 0.0 };
            corrections.iter_mut().for_each(|correction| correction[row][column].value -= away);
        }
    }
}
