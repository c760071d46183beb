//! Pruning of plain Gaussians to a number, by what the training views lose (METHOD.md §5).

use super::PlainTrainer;
use crate::{
    render::STATISTICS,
    train::{
        Result,
        model_trainer::{Step, Views},
        removal_losses::removal_losses,
    },
};

impl PlainTrainer {
    /// Whether Gaussians are pruned to a number after `step`.
    pub(super) fn prunes_after(&self, step: u32) -> bool {
        self.kept_after(step).is_some()
    }

    fn kept_after(&self, step: u32) -> Option<usize> {
        self.schedule.pruning.and_then(|pruning| pruning.kept_after(step, self.rows.count))
    }

    /// Prunes those without which the error of the training views grows least, if a round follows `step`.
    pub(super) fn prune_after(&mut self, step: &Step, views: &mut Views<'_>) -> Result<()> {
        if let Some(pruning) = self.schedule.pruning
            && pruning.is_missed(step.number, self.rows.count)
        {
            tracing::warn!(
                "target of {} Gaussians not reached: growth ended at {}, and none are pruned",
                pruning.target,
                self.rows.count
            );
        }
        let Some(kept) = self.kept_after(step.number).filter(|kept| *kept < self.rows.count) else {
            return Ok(());
        };
        let device = self.device.clone();
        let losses = removal_losses(self, &device, step, views)?;
        let mut state = self.download()?;
        state.retain(&largest(&losses, kept));
        tracing::debug!(step = step.number, gaussians = state.values.len(), "Gaussians pruned to a number");
        self.statistics = device.buffer("growth statistics", STATISTICS * state.values.len())?;
        self.upload(&state)
    }
}

/// Which of `values` are among the `count` largest; the first ones among equals.
fn largest(values: &[f64], count: usize) -> Vec<bool> {
    let mut order: Vec<usize> = (0..values.len()).collect();
    order.sort_by(|a, b| values[*b].total_cmp(&values[*a]).then(a.cmp(b)));
    let mut kept = vec![false; values.len()];
    for index in &order[..count.min(order.len())] {
        kept[*index] = true;
    }
    kept
}

#[cfg(test)]
mod tests {
    use super::largest;

    #[test]
    fn the_largest_are_kept_and_the_first_of_equals() {
        assert_eq!(largest(&[1.0, 3.0, -2.0, 3.0, 1.0], 3), [true, true, false, true, false]);
        assert_eq!(largest(&[1.0, f64::NEG_INFINITY], 5), [true; 2]);
        assert_eq!(largest(&[], 1), [false; 0]);
    }
}
