//! Bar chart of the file's size by section.

use maud::{Markup, html};

use super::units::{bytes, size};
use crate::domain::ByteCounts;

const WIDTH: f64 = 560.0;
const ROW: f64 = 26.0;
/// Widths of the names, and of the figures at the bars' ends.
const NAMES: f64 = 92.0;
const FIGURES: f64 = 130.0;

/// The section of bytes; `anchors` and `gaussians` for what each costs.
pub(super) fn bars(counts: &ByteCounts, anchors: u64, gaussians: u64) -> Markup {
    let mut parts: Vec<(&str, u64)> = counts.parts().into_iter().filter(|(_, bytes)| *bytes > 0).collect();
    parts.sort_by_key(|(_, bytes)| std::cmp::Reverse(*bytes));
    let max = parts.first().map_or(1, |(_, bytes)| *bytes).max(1) as f64;
    let total = counts.total.max(1) as f64;
    let height = ROW * parts.len() as f64;
    let each = |count: u64| format!("{:.2}", 8.0 * counts.total as f64 / count.max(1) as f64);
    html! {
        section {
            h2 { "Where the bytes went" }
            p {
                (bytes(counts.total)) " in all: " (each(anchors)) " bits per anchor, " (each(gaussians)) " bits per Gaussian."
            }
            svg.bars viewBox=(format!("0 0 {WIDTH} {height}")) role="img" aria-label="Bytes by part of the file" {
                @for (row, (name, count)) in parts.iter().enumerate() {
                    @let top = row as f64 * ROW;
                    @let length = (WIDTH - NAMES - FIGURES) * *count as f64 / max;
                    text.name x=(NAMES - 8.0) y=(top + ROW / 2.0) text-anchor="end" dominant-baseline="middle" { (name) }
                    rect.bar x=(NAMES) y=(top + 4.0) width=(format!("{:.1}", length.max(1.0))) height=(ROW - 8.0) rx="2" {
                        title { (name) ": " (bytes(*count)) }
                    }
                    text.count x=(format!("{:.1}", NAMES + length.max(1.0) + 6.0)) y=(top + ROW / 2.0)
                        dominant-baseline="middle" {
                        (size(*count)) " (" (format!("{:.1}", 100.0 * *count as f64 / total)) " %)"
                    }
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn parts_come_by_size_and_empty_ones_not_at_all() {
        let counts = ByteCounts { total: 4000, positions: 1000, features: 3000, ..ByteCounts::default() };
        let text = bars(&counts, 10, 20).into_string();
        let at = |word: &str| text.find(word).unwrap_or_else(|| panic!("no {word}: {text}"));
        assert!(at(">features<") < at(">positions<") && !text.contains("planes"));
        assert!(text.contains("3.00 kB (75.0 %)") && text.contains("3200.00 bits per anchor"), "{text}");
    }
}
