//! Curves as SVG, drawn on the server: they need no script, use the page's colours and can be printed.

use maud::{Markup, html};

const WIDTH: f64 = 440.0;
const HEIGHT: f64 = 260.0;
const LEFT: f64 = 58.0;
const RIGHT: f64 = 16.0;
const TOP: f64 = 12.0;
const BOTTOM: f64 = 46.0;
/// Gaps between marks on an axis, about.
const GAPS: f64 = 5.0;
/// Points of a line; more would not be visible.
const MOST_POINTS: usize = 400;

/// One curve.
#[derive(Debug)]
pub(super) struct Series {
    /// Label in the legend.
    pub(super) name: &'static str,
    pub(super) points: Vec<(f64, f64)>,
    /// A name for each point, for a curve of few points that are shown as such; else empty.
    pub(super) labels: Vec<String>,
}

/// Curves over a common axis.
#[derive(Debug)]
pub(super) struct Chart {
    pub(super) title: &'static str,
    pub(super) x: String,
    pub(super) y: &'static str,
    pub(super) series: Vec<Series>,
}

impl Chart {
    /// The chart as a figure, or a sentence if there is nothing to draw.
    pub(super) fn figure(&self, caption: &str) -> Markup {
        html! {
            figure.chart {
                h3 { (self.title) }
                @if self.all().next().is_some() {
                    (self.svg())
                    p.legend {
                        @for (number, series) in self.drawn() {
                            span.{"key s" (number)} {} " " (series.name) " "
                        }
                    }
                } @else {
                    p.none { "There are no figures for this curve." }
                }
                figcaption { (caption) }
            }
        }
    }

    fn drawn(&self) -> impl Iterator<Item = (usize, &Series)> {
        self.series.iter().enumerate().filter(|(_, series)| !series.points.is_empty())
    }

    fn all(&self) -> impl Iterator<Item = (f64, f64)> {
        self.series.iter().flat_map(|series| series.points.iter().copied())
    }

    fn svg(&self) -> Markup {
        let across = Axis::of(self.all().map(|(x, _)| x), LEFT, WIDTH - RIGHT);
        let up = Axis::of(self.all().map(|(_, y)| y), HEIGHT - BOTTOM, TOP);
        let place = |(x, y): (f64, f64)| format!("{:.1},{:.1}", across.place(x), up.place(y));
        let description = format!("{} against {}", self.y, self.x);
        html! {
            svg viewBox=(format!("0 0 {WIDTH} {HEIGHT}")) role="img" aria-label=(description) {
                @for tick in up.ticks() {
                    @let y = format!("{:.1}", up.place(tick));
                    line.grid x1=(LEFT) x2=(WIDTH - RIGHT) y1=(y) y2=(y) {}
                    text.tick x=(LEFT - 8.0) y=(y) text-anchor="end" dominant-baseline="middle" { (up.label(tick)) }
                }
                @for tick in across.ticks() {
                    @let x = format!("{:.1}", across.place(tick));
                    line.grid x1=(x) x2=(x) y1=(TOP) y2=(HEIGHT - BOTTOM) {}
                    text.tick x=(x) y=(HEIGHT - BOTTOM + 18.0) text-anchor="middle" { (across.label(tick)) }
                }
                text.axis x=((LEFT + WIDTH - RIGHT) / 2.0) y=(HEIGHT - 6.0) text-anchor="middle" { (self.x) }
                text.axis x="14" y=((TOP + HEIGHT - BOTTOM) / 2.0) text-anchor="middle"
                    transform=(format!("rotate(-90 14 {})", (TOP + HEIGHT - BOTTOM) / 2.0)) { (self.y) }
                @for (number, series) in self.drawn() {
                    @if series.points.len() > 1 {
                        polyline.{"line s" (number)}
                            points=(thinned(&series.points).map(place).collect::<Vec<_>>().join(" ")) {}
                    }
                    @if series.points.len() == 1 || !series.labels.is_empty() {
                        @for (index, point) in series.points.iter().enumerate() {
                            circle.{"dot s" (number)} cx=(format!("{:.1}", across.place(point.0)))
                                cy=(format!("{:.1}", up.place(point.1))) r="4" {
                                title {
                                    @if let Some(label) = series.labels.get(index) { (label) ": " }
                                    (format!("{:.2}", point.1)) " " (self.y)
                                }
                            }
                        }
                    }
                }
            }
        }
    }
}

/// Every so-manyth point, and the last.
fn thinned(points: &[(f64, f64)]) -> impl Iterator<Item = (f64, f64)> {
    let stride = points.len().div_ceil(MOST_POINTS).max(1);
    let last = points.len().saturating_sub(1);
    points
        .iter()
        .enumerate()
        .filter(move |(index, _)| index % stride == 0 || *index == last)
        .map(|(_, point)| *point)
}

/// Values along one side of the picture.
#[derive(Debug, Clone, Copy)]
struct Axis {
    low: f64,
    high: f64,
    step: f64,
    /// Where `low` and `high` are in the picture.
    from: f64,
    to: f64,
}

impl Axis {
    /// An axis with room for all values, which begins and ends at round ones.
    fn of(values: impl Iterator<Item = f64>, from: f64, to: f64) -> Self {
        let (mut low, mut high) =
            values.fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), v| (low.min(v), high.max(v)));
        if high - low < 1e-9 * high.abs().max(1.0) {
            let room = (0.05 * high.abs()).max(0.5);
            (low, high) = (low - room, high + room);
        }
        let step = round_step((high - low) / GAPS);
        Self { low: (low / step).floor() * step, high: (high / step).ceil() * step, step, from, to }
    }

    fn place(&self, value: f64) -> f64 {
        self.from + (value - self.low) / (self.high - self.low) * (self.to - self.from)
    }

    fn ticks(&self) -> impl Iterator<Item = f64> {
        let Self { low, step, high, .. } = *self;
        let count = ((high - low) / step).round().clamp(0.0, 50.0) as u32;
        (0..=count).map(move |number| low + f64::from(number) * step)
    }

    fn label(&self, value: f64) -> String {
        let decimals = (-self.step.log10().floor()).clamp(0.0, 12.0) as usize;
        // A rounding error must not make a zero negative.
        let value = if value.abs() < self.step * 1e-6 { 0.0 } else { value };
        format!("{value:.decimals$}")
    }
}

/// The step of 1, 2 or 5 times a power of ten that is next above `about`.
fn round_step(about: f64) -> f64 {
    let power = 10.0_f64.powf(about.log10().floor());
    let factor = [1.0, 2.0, 5.0].into_iter().find(|factor| factor * power >= about * (1.0 - 1e-9));
    factor.unwrap_or(10.0) * power
}

#[cfg(test)]
mod tests {
    use super::*;

    fn chart(points: Vec<(f64, f64)>) -> Chart {
        let series = Series { name: "a <series>", points, labels: Vec::new() };
        Chart { title: "T", x: "seconds".to_owned(), y: "dB", series: vec![series] }
    }

    #[test]
    fn axes_begin_and_end_at_round_values_and_hold_every_point() {
        for (low, high) in [(0.0, 1.0), (17.3, 31.9), (1e-6, 3e-6), (-4.0, 9.0e8), (5.0, 5.0), (0.0, 0.0)] {
            let axis = Axis::of([low, high].into_iter(), 0.0, 100.0);
            assert!(axis.low <= low && axis.high >= high, "{axis:?}");
            let ticks: Vec<f64> = axis.ticks().collect();
            assert!((2..=8).contains(&ticks.len()), "{axis:?}: {ticks:?}");
            assert!((axis.place(ticks[0]), axis.place(ticks[ticks.len() - 1])) == (0.0, 100.0), "{axis:?}");
        }
        let axis = Axis::of([0.0, 0.21].into_iter(), 0.0, 1.0);
        assert_eq!(
            axis.ticks().map(|tick| axis.label(tick)).collect::<Vec<_>>(),
            ["0.00", "0.05", "0.10", "0.15", "0.20", "0.25"]
        );
    }

    #[test]
    fn a_long_line_is_thinned_and_keeps_its_ends() {
        let points: Vec<(f64, f64)> = (0..10_001).map(|i| (f64::from(i), 1.0)).collect();
        let thin: Vec<_> = thinned(&points).collect();
        assert!(thin.len() <= MOST_POINTS + 1, "{}", thin.len());
        assert_eq!((thin[0].0, thin[thin.len() - 1].0), (0.0, 10_000.0));
        assert_eq!(thinned(&[]).count(), 0);
    }

    #[test]
    fn charts_escape_their_words_and_say_so_when_there_is_nothing_to_draw() {
        let drawn = chart(vec![(0.0, 1.0), (1.0, 2.0)]).figure("<caption>").into_string();
        assert!(
            drawn.contains("<polyline")
                && drawn.contains("a &lt;series&gt;")
                && drawn.contains("&lt;caption&gt;")
        );
        assert!(!drawn.contains("NaN"), "{drawn}");
        let empty = chart(Vec::new()).figure("").into_string();
        assert!(!empty.contains("<svg") && empty.contains("no figures"), "{empty}");
    }
}
