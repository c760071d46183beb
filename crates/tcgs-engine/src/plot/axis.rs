//! One side of a chart: which values it spans, where they lie and which are marked.

/// Gaps between marks on a linear axis, about.
const GAPS: f64 = 5.0;

/// How values are spaced.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Scale {
    /// Evenly.
    #[default]
    Linear,
    /// By their logarithms; values that are not positive are left out.
    Log,
}

/// Values along one side of the picture.
#[derive(Debug, Clone, Copy)]
pub(super) struct Axis {
    pub(super) scale: Scale,
    pub(super) low: f64,
    pub(super) high: f64,
    step: f64,
    /// Where `low` and `high` are in the picture.
    from: f64,
    to: f64,
}

impl Axis {
    /// An axis with room for all values, which begins and ends at round ones.
    pub(super) fn of(scale: Scale, values: impl Iterator<Item = f64>, from: f64, to: f64) -> Self {
        let known = values.filter(|value| shows(scale, *value));
        let (mut low, mut high) =
            known.fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), v| (low.min(v), high.max(v)));
        if low > high {
            (low, high) = (1.0, 1.0);
        }
        if scale == Scale::Log {
            let (low, high) = (mark_below(low), mark_above(high));
            let high = if low < high { high } else { high * 2.0 };
            return Self { scale, low, high, step: 1.0, from, to };
        }
        if high - low < 1e-9 * high.abs().max(1.0) {
            let room = (0.05 * high.abs()).max(0.5);
            (low, high) = (low - room, high + room);
        }
        let step = mark_above((high - low) / GAPS);
        Self { scale, low: (low / step).floor() * step, high: (high / step).ceil() * step, step, from, to }
    }

    pub(super) fn place(&self, value: f64) -> f64 {
        let share = match self.scale {
            Scale::Linear => (value - self.low) / (self.high - self.low),
            Scale::Log => (value / self.low).ln() / (self.high / self.low).ln(),
        };
        self.from + share * (self.to - self.from)
    }

    pub(super) fn ticks(&self) -> Vec<f64> {
        let Self { low, step, high, .. } = *self;
        match self.scale {
            Scale::Linear => {
                let count = ((high - low) / step).round().clamp(0.0, 50.0) as u32;
                (0..=count).map(|number| low + f64::from(number) * step).collect()
            }
            Scale::Log => log_ticks(low, high),
        }
    }

    pub(super) fn label(&self, value: f64) -> String {
        if self.scale == Scale::Log {
            return short(value);
        }
        let decimals = (-self.step.log10().floor()).clamp(0.0, 12.0) as usize;
        // A rounding error must not make a zero negative.
        let value = if value.abs() < self.step * 1e-6 { 0.0 } else { value };
        format!("{value:.decimals$}")
    }
}

/// Whether a value has a place on such an axis.
pub(super) fn shows(scale: Scale, value: f64) -> bool {
    value.is_finite() && (scale == Scale::Linear || value > 0.0)
}

/// The least 1, 2 or 5 times a power of ten that is not below `value`.
fn mark_above(value: f64) -> f64 {
    let power = 10.0_f64.powf(value.log10().floor());
    let factor = [1.0, 2.0, 5.0].into_iter().find(|factor| factor * power >= value * (1.0 - 1e-9));
    factor.unwrap_or(10.0) * power
}

/// The largest that is not above it.
fn mark_below(value: f64) -> f64 {
    let power = 10.0_f64.powf(value.log10().floor());
    let factor = [5.0, 2.0, 1.0].into_iter().find(|factor| factor * power <= value * (1.0 + 1e-9));
    factor.unwrap_or(1.0) * power
}

/// Marks of a logarithmic axis: 1, 2 and 5 in each decade, powers of ten alone if those would be too many.
fn log_ticks(low: f64, high: f64) -> Vec<f64> {
    let decades = low.log10().floor() as i32..=high.log10().ceil() as i32;
    let of = |factors: &[f64]| -> Vec<f64> {
        let all = decades.clone().flat_map(|decade| factors.iter().map(move |f| f * 10.0_f64.powi(decade)));
        all.filter(|mark| *mark >= low * (1.0 - 1e-9) && *mark <= high * (1.0 + 1e-9)).collect()
    };
    let fine = of(&[1.0, 2.0, 5.0]);
    if fine.len() > 8 { of(&[1.0]) } else { fine }
}

/// 2, 0.05, 20k, 5M: a mark of a logarithmic axis.
fn short(value: f64) -> String {
    for (unit, suffix) in [(1e9, "G"), (1e6, "M"), (1e3, "k")] {
        if value >= unit * (1.0 - 1e-9) {
            return format!("{}{suffix}", (value / unit).round());
        }
    }
    let decimals = (-value.log10().floor()).clamp(0.0, 12.0) as usize;
    if decimals > 4 { format!("{value:.0e}") } else { format!("{value:.decimals$}") }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn axes_begin_and_end_at_round_values_and_hold_every_point() {
        for (low, high) in [(0.0, 1.0), (17.3, 31.9), (1e-6, 3e-6), (-4.0, 9.0e8), (5.0, 5.0), (0.0, 0.0)] {
            let axis = Axis::of(Scale::Linear, [low, high].into_iter(), 0.0, 100.0);
            assert!(axis.low <= low && axis.high >= high, "{axis:?}");
            let ticks = axis.ticks();
            assert!((2..=8).contains(&ticks.len()), "{axis:?}: {ticks:?}");
            assert!((axis.place(ticks[0]), axis.place(ticks[ticks.len() - 1])) == (0.0, 100.0), "{axis:?}");
        }
        let axis = Axis::of(Scale::Linear, [0.0, 0.21].into_iter(), 0.0, 1.0);
        assert_eq!(
            axis.ticks().into_iter().map(|tick| axis.label(tick)).collect::<Vec<_>>(),
            ["0.00", "0.05", "0.10", "0.15", "0.20", "0.25"]
        );
    }

    #[test]
    fn logarithmic_axes_are_marked_at_powers_and_leave_out_what_has_no_logarithm() {
        let axis = Axis::of(Scale::Log, [0.0, -3.0, 30_000.0, 700_000.0].into_iter(), 0.0, 100.0);
        assert_eq!((axis.low, axis.high), (20_000.0, 1e6));
        let labels: Vec<String> = axis.ticks().into_iter().map(|tick| axis.label(tick)).collect();
        assert_eq!(labels, ["20k", "50k", "100k", "200k", "500k", "1M"]);
        let [low, high] = [axis.place(20_000.0), axis.place(1e6)];
        assert!(low.abs() < 1e-9 && (high - 100.0).abs() < 1e-9);
        let wide = Axis::of(Scale::Log, [1e-9, 1.0].into_iter(), 0.0, 1.0);
        assert!(wide.ticks().len() <= 11, "{:?}", wide.ticks());
        assert_eq!(Axis::of(Scale::Log, [0.05].into_iter(), 0.0, 1.0).label(0.05), "0.05");
        for value in [1e-7, 3.0, 1e12] {
            let one = Axis::of(Scale::Log, [value].into_iter(), 0.0, 1.0);
            assert!(
                one.low <= value * 1.000_001 && one.high >= value * 0.999_999 && one.low < one.high,
                "{one:?}"
            );
        }
        assert!(Axis::of(Scale::Log, std::iter::empty(), 0.0, 1.0).place(1.0).is_finite());
    }
}
