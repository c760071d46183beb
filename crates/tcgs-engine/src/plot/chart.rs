//! Lines and points over two axes.

use maud::{Markup, PreEscaped, html};

use super::axis::{Axis, Scale, shows};

const WIDTH: f64 = 440.0;
const HEIGHT: f64 = 260.0;
const LEFT: f64 = 58.0;
const RIGHT: f64 = 16.0;
const TOP: f64 = 12.0;
const BOTTOM: f64 = 46.0;
/// Height of a line of the legend in a picture that stands alone, and of a chart's title.
const LEGEND_LINE: f64 = 18.0;
const TITLE: f64 = 26.0;
/// Points of a line; more would not be visible.
const MOST_POINTS: usize = 400;

/// Number of styles of series; further ones use them again.
pub const SERIES_STYLES: usize = 8;

/// Colors of a picture that stands alone: a page, its text, its rules and the series, in light and dark.
const STANDALONE_STYLE: &str = "\
svg { --page: #fff; --ink: #1f2328; --soft: #59636e; --rule: #d1d9e0; --s0: #1d5fd1; --s1: #c2410c; --s2: #18794e; --s3: #8250df; --s4: #a8820a; --s5: #bf3989; --s6: #0a7ea4; --s7: #6e7781; }\n\
@media (prefers-color-scheme: dark) { svg { --page: #0d1117; --ink: #f0f6fc; --soft: #9198a1; --rule: #3d444d; --s0: #7fb0ff; --s1: #ff9d5c; --s2: #5fd09a; --s3: #c297ff; --s4: #e3b341; --s5: #f778ba; --s6: #56c8e8; --s7: #9198a1; } }\n\
text { font: 12px system-ui, sans-serif; fill: var(--soft); } .name { fill: var(--ink); font-weight: 600; }\n\
.page { fill: var(--page); } .grid { stroke: var(--rule); } .line { fill: none; stroke: var(--c); stroke-width: 2; stroke-linejoin: round; } .dot { fill: var(--c); } .spread { stroke: var(--c); }\n\
.s0 { --c: var(--s0); } .s1 { --c: var(--s1); } .s2 { --c: var(--s2); } .s3 { --c: var(--s3); } .s4 { --c: var(--s4); } .s5 { --c: var(--s5); } .s6 { --c: var(--s6); } .s7 { --c: var(--s7); }\n";

/// One curve.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Series {
    /// Label in the legend. Series of one name share its style and its line there.
    pub name: String,
    /// Its points, in the order in which they are joined.
    pub points: Vec<(f64, f64)>,
    /// Half the interval of each point's second figure; else empty.
    pub spreads: Vec<Option<f64>>,
    /// A name for each point, for a curve of few points that are shown as such; else empty.
    pub labels: Vec<String>,
    /// Whether its points are not joined.
    pub is_scattered: bool,
}

/// Curves over common axes.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Chart {
    /// What is shown.
    pub title: String,
    /// Quantity and unit of the first figures.
    pub x: String,
    /// Of the second.
    pub y: String,
    /// Spacing of the first.
    pub x_scale: Scale,
    /// Spacing of the second.
    pub y_scale: Scale,
    /// The curves.
    pub series: Vec<Series>,
}

impl Chart {
    /// The chart as a figure of a page, or a sentence if there is nothing to draw.
    #[must_use]
    pub fn figure(&self, caption: &str) -> Markup {
        html! {
            figure.chart {
                h3 { (self.title) }
                @if self.is_empty() {
                    p.none { "There are no figures for this curve." }
                } @else {
                    @let names = names(&[self]);
                    svg viewBox=(format!("0 0 {WIDTH} {HEIGHT}")) role="img" aria-label=(self.description()) { (self.content(&names)) }
                    p.legend {
                        @for (number, name) in names.iter().enumerate() {
                            span.{"key s" (number % SERIES_STYLES)} {} " " (name) " "
                        }
                    }
                }
                figcaption { (caption) }
            }
        }
    }

    /// The chart as an SVG file with its own colors, title and legend; `None` if there is nothing to draw.
    #[must_use]
    pub fn standalone(&self) -> Option<String> {
        if self.is_empty() {
            return None;
        }
        let names = names(&[self]);
        let top = TITLE + HEIGHT + 8.0;
        let size = [WIDTH, top + LEGEND_LINE * names.len() as f64];
        let title = format!("{}: {}", self.title, self.description());
        Some(file(&title, size, html! { (self.titled(&names)) (legend(&names, LEFT, top)) }))
    }

    /// Charts in two columns as one SVG file with its own colors, title and legend, in which equal names of series have one style;
    /// `None` if there is nothing to draw.
    #[must_use]
    pub fn sheet(title: &str, charts: &[&Self]) -> Option<String> {
        let charts: Vec<&Self> = charts.iter().copied().filter(|chart| !chart.is_empty()).collect();
        let names = names(&charts);
        let row = TITLE + HEIGHT;
        let place = |number: usize| (WIDTH * (number % 2) as f64, row * (number / 2) as f64);
        // Beside the last chart of an odd number, else below.
        let (left, top) = place(charts.len());
        let bottom = top + 32.0 + LEGEND_LINE * names.len() as f64;
        let size = [2.0 * WIDTH, bottom.max(row * charts.len().div_ceil(2) as f64)];
        let picture = html! {
            @for (number, chart) in charts.iter().enumerate() {
                @let (x, y) = place(number);
                g transform=(format!("translate({x} {y})")) { (chart.titled(&names)) }
            }
            (legend(&names, left + LEFT, top + 32.0))
        };
        (!charts.is_empty()).then(|| file(title, size, picture))
    }

    /// The chart below its title.
    fn titled(&self, names: &[&str]) -> Markup {
        html! {
            text.name x="12" y="18" { (self.title) }
            g transform=(format!("translate(0 {TITLE})")) { (self.content(names)) }
        }
    }

    fn description(&self) -> String {
        format!("{} against {}", self.y, self.x)
    }

    fn is_empty(&self) -> bool {
        self.all().next().is_none()
    }

    /// The series with a point on the axes, each with its style, which is the place of its name among `names`.
    fn drawn<'a>(&'a self, names: &'a [&str]) -> impl Iterator<Item = (usize, &'a Series)> + 'a {
        self.series.iter().filter_map(|series| {
            let style = names.iter().position(|name| *name == series.name)?;
            self.shown(series).next().map(|_| (style % SERIES_STYLES, series))
        })
    }

    /// The points that have a place on the axes, with their numbers.
    fn shown<'a>(&'a self, series: &'a Series) -> impl Iterator<Item = (usize, (f64, f64))> + 'a {
        let points = series.points.iter().copied().enumerate();
        points.filter(|(_, (x, y))| shows(self.x_scale, *x) && shows(self.y_scale, *y))
    }

    fn all(&self) -> impl Iterator<Item = (f64, f64)> {
        self.series.iter().flat_map(|series| self.shown(series).map(|(_, point)| point))
    }

    /// Second figures with the ends of their intervals.
    fn heights(&self) -> impl Iterator<Item = f64> {
        self.series.iter().flat_map(|series| {
            self.shown(series).flat_map(|(index, (_, y))| {
                let half = series.spreads.get(index).copied().flatten().unwrap_or(0.0);
                [y, y - half, y + half]
            })
        })
    }

    fn content(&self, names: &[&str]) -> Markup {
        let across = Axis::of(self.x_scale, self.all().map(|(x, _)| x), LEFT, WIDTH - RIGHT);
        let up = Axis::of(self.y_scale, self.heights(), HEIGHT - BOTTOM, TOP);
        let place = |(x, y): (f64, f64)| format!("{:.1},{:.1}", across.place(x), up.place(y));
        html! {
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
            @for (style, series) in self.drawn(names) {
                @let points: Vec<(usize, (f64, f64))> = self.shown(series).collect();
                @if points.len() > 1 && !series.is_scattered {
                    polyline.{"line s" (style)} points=(thinned(&points).map(place).collect::<Vec<_>>().join(" ")) {}
                }
                @for (index, (x, y)) in &points {
                    @if let Some(Some(half)) = series.spreads.get(*index) {
                        @let x = format!("{:.1}", across.place(*x));
                        @let [high, low] = [y + half, (y - half).max(up.low)].map(|end| format!("{:.1}", up.place(end)));
                        line.{"spread s" (style)} x1=(x) x2=(x) y1=(high) y2=(low) {}
                    }
                }
                @if points.len() == 1 || series.is_scattered || !series.labels.is_empty() {
                    @for (index, point) in &points {
                        circle.{"dot s" (style)} cx=(format!("{:.1}", across.place(point.0)))
                            cy=(format!("{:.1}", up.place(point.1))) r="4" {
                            title {
                                @if let Some(label) = series.labels.get(*index) { (label) ": " }
                                (figure(point.1)) " " (self.y)
                            }
                        }
                    }
                }
            }
        }
    }
}

/// The names of the series that charts draw, once each, in the order in which they first appear.
fn names<'a>(charts: &[&'a Chart]) -> Vec<&'a str> {
    let mut names: Vec<&str> = Vec::new();
    for chart in charts {
        for series in chart.series.iter().filter(|series| chart.shown(series).next().is_some()) {
            if !names.contains(&series.name.as_str()) {
                names.push(&series.name);
            }
        }
    }
    names
}

/// A line for each name, the first one at `top`.
fn legend(names: &[&str], left: f64, top: f64) -> Markup {
    html! {
        @for (number, name) in names.iter().enumerate() {
            @let y = top + LEGEND_LINE * number as f64;
            circle.{"dot s" (number % SERIES_STYLES)} cx=(left + 4.0) cy=(y - 4.0) r="4" {}
            text x=(left + 14.0) y=(y) { (name) }
        }
    }
}

/// An SVG file with its own colors.
fn file(title: &str, [width, height]: [f64; 2], content: Markup) -> String {
    let picture = html! {
        svg xmlns="http://www.w3.org/2000/svg" width=(width) height=(height)
            viewBox=(format!("0 0 {width} {height}")) role="img" {
            title { (title) }
            style { (PreEscaped(STANDALONE_STYLE)) }
            rect.page width=(width) height=(height) {}
            (content)
        }
    };
    picture.into_string() + "\n"
}

/// A point's figure in words: two decimals, or three digits if it is small.
fn figure(value: f64) -> String {
    if value == 0.0 || value.abs() >= 0.1 { format!("{value:.2}") } else { format!("{value:.2e}") }
}

/// Every so-manyth point, and the last.
fn thinned(points: &[(usize, (f64, f64))]) -> impl Iterator<Item = (f64, f64)> {
    let stride = points.len().div_ceil(MOST_POINTS).max(1);
    let last = points.len().saturating_sub(1);
    points
        .iter()
        .enumerate()
        .filter(move |(index, _)| index % stride == 0 || *index == last)
        .map(|(_, (_, point))| *point)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn series(name: &str, points: Vec<(f64, f64)>) -> Series {
        Series { name: name.to_owned(), points, ..Series::default() }
    }

    fn chart(series: Vec<Series>) -> Chart {
        let [title, x, y] = ["T", "seconds", "dB"].map(str::to_owned);
        Chart { title, x, y, series, ..Chart::default() }
    }

    #[test]
    fn a_long_line_is_thinned_and_keeps_its_ends() {
        let points: Vec<(usize, (f64, f64))> = (0..10_001).map(|i| (i, (i as f64, 1.0))).collect();
        let thin: Vec<_> = thinned(&points).collect();
        assert!(thin.len() <= MOST_POINTS + 1, "{}", thin.len());
        assert_eq!((thin[0].0, thin[thin.len() - 1].0), (0.0, 10_000.0));
        assert_eq!(thinned(&[]).count(), 0);
    }

    #[test]
    fn charts_escape_their_words_and_say_so_when_there_is_nothing_to_draw() {
        let line = chart(vec![series("a <series>", vec![(0.0, 1.0), (1.0, 2.0)])]);
        let drawn = line.figure("<caption>").into_string();
        assert!(
            drawn.contains("<polyline")
                && drawn.contains("a &lt;series&gt;")
                && drawn.contains("&lt;caption&gt;")
        );
        assert!(!drawn.contains("NaN"), "{drawn}");
        let empty = chart(vec![series("none", Vec::new())]);
        let figure = empty.figure("").into_string();
        assert!(!figure.contains("<svg") && figure.contains("no figures"), "{figure}");
        assert_eq!(empty.standalone(), None);
    }

    #[test]
    fn series_of_one_name_share_a_style_and_intervals_are_drawn() {
        let mut dots = series("b", vec![(1.0, 5.0), (2.0, 6.0)]);
        dots.spreads = vec![Some(0.5), None];
        dots.is_scattered = true;
        let line = |name| series(name, vec![(1.0, 1.0), (3.0, 2.0)]);
        let chart = chart(vec![line("a"), line("b"), line("a"), dots]);
        let picture = chart.standalone().expect("a picture");
        assert!(picture.starts_with("<svg xmlns=\"http://www.w3.org/2000/svg\""), "{picture}");
        assert_eq!(picture.matches("class=\"line s0\"").count(), 2);
        assert_eq!(picture.matches("class=\"line s1\"").count(), 1);
        assert_eq!(picture.matches("class=\"spread s1\"").count(), 1);
        // Two points and one key for each name.
        assert_eq!(picture.matches("class=\"dot s1\"").count(), 3);
        assert_eq!(picture.matches("class=\"dot s0\"").count(), 1);
    }

    #[test]
    fn charts_of_a_sheet_share_styles_and_one_legend() {
        let line = |name| series(name, vec![(1.0, 1.0), (3.0, 2.0)]);
        let (first, second) = (chart(vec![line("a"), line("b")]), chart(vec![line("c"), line("b")]));
        let sheet = Chart::sheet("several", &[&first, &second, &chart(Vec::new())]).expect("a picture");
        assert_eq!(sheet.matches("class=\"line s1\"").count(), 2, "b is the second in both");
        assert_eq!(sheet.matches("class=\"line s2\"").count(), 1);
        assert_eq!(sheet.matches("<circle").count(), 3, "keys of a, b and c");
        assert!(sheet.contains("<title>several</title>") && sheet.contains("translate(440 0)"), "{sheet}");
        assert_eq!(Chart::sheet("none", &[&chart(Vec::new())]), None);
    }

    #[test]
    fn what_has_no_logarithm_is_not_drawn_on_a_logarithmic_axis() {
        let mut chart = chart(vec![series("a", vec![(0.0, 1.0), (10.0, 2.0), (100.0, 3.0)])]);
        chart.x_scale = Scale::Log;
        let drawn = chart.figure("").into_string();
        assert!(!drawn.contains("inf") && !drawn.contains("NaN"), "{drawn}");
        let line = drawn.split("<polyline").nth(1).expect("a line");
        assert_eq!(line.split('>').next().expect("an element").matches(',').count(), 2, "{line}");
    }
}
