//! The pace of a run along its schedule: after it has converged, the rest of the schedule takes a third of its steps.
//!
//! Invariants: landmarks keep their order; none after the change of pace comes before it; the run's last step is at the schedule's
//! end. At full length every landmark and every place is the schedule's own, to the bit.

/// How many times faster the rest of the schedule passes once a run has converged. Growth, masks, context model and rounding then
/// still have the steps that they have in a run of the length that remains.
pub(super) const FACTOR: u32 = 3;

/// The pace of a run along its schedule.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Pace {
    /// Steps of the whole schedule.
    full_steps: u32,
    /// The last step at the schedule's own pace; none at full length.
    hastened_after: Option<u32>,
}

impl Pace {
    /// A run of full length.
    pub(super) fn full(full_steps: u32) -> Self {
        Self { full_steps, hastened_after: None }
    }

    /// Faster after `step`, which is before the schedule's end.
    pub(super) fn hastened_after(full_steps: u32, step: u32) -> Self {
        Self { full_steps, hastened_after: Some(step.min(full_steps)) }
    }

    /// The first step at the faster pace.
    pub(super) fn first_hastened(&self) -> Option<u32> {
        self.hastened_after.map(|after| after.saturating_add(1))
    }

    /// How many times faster the schedule passes at `step`.
    pub(super) fn factor(&self, step: u32) -> u32 {
        if self.first_hastened().is_some_and(|first| step >= first) { FACTOR } else { 1 }
    }

    /// Steps of the run.
    pub(super) fn steps(&self) -> u32 {
        self.step_of(self.full_steps)
    }

    /// The step of the run that comes to the schedule's `landmark`.
    pub(super) fn step_of(&self, landmark: u32) -> u32 {
        match self.hastened_after {
            Some(after) if landmark > after => after + (landmark - after).div_ceil(FACTOR),
            _ => landmark,
        }
    }

    /// The share of the schedule that is done after the run's `step`.
    pub(super) fn fraction(&self, step: u32) -> f64 {
        f64::from(self.place(step)) / f64::from(self.full_steps.max(1))
    }

    /// The schedule's step that the run's `step` comes to.
    pub(super) fn place(&self, step: u32) -> u32 {
        match self.hastened_after {
            Some(after) if step > after => {
                after.saturating_add((step - after).saturating_mul(FACTOR)).min(self.full_steps)
            }
            _ => step,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_run_of_full_length_has_the_schedules_own_steps() {
        let pace = Pace::full(300);
        assert!((0..=300).all(|step| pace.step_of(step) == step && pace.place(step) == step));
        assert_eq!(pace.factor(300), 1);
        assert_eq!(pace.steps(), 300);
    }

    #[test]
    fn a_hastened_run_keeps_the_order_of_its_landmarks_and_ends_at_the_end() {
        for (steps, after) in [(300, 100), (301, 100), (302, 1), (7, 6), (7, 7), (1, 0)] {
            let pace = Pace::hastened_after(steps, after);
            assert!((0..=after).all(|step| pace.step_of(step) == step && pace.place(step) == step));
            assert!((0..steps).all(|landmark| pace.step_of(landmark) <= pace.step_of(landmark + 1)));
            assert!((after + 1..=steps).all(|landmark| pace.step_of(landmark) > after));
            assert!((0..pace.steps()).all(|step| pace.place(step) < pace.place(step + 1)));
            assert!((0..=steps).all(|landmark| pace.place(pace.step_of(landmark)) >= landmark));
            assert_eq!(pace.steps(), after + (steps - after).div_ceil(FACTOR));
            assert_eq!(pace.place(pace.steps()), steps);
        }
    }
}
