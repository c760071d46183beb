//! A report as one page that needs nothing else: charts are inline SVG.

use maud::{DOCTYPE, Markup, PreEscaped, html};

use super::section::{Block, Section, Table};

const STYLE: &str = include_str!("style.css");

/// The page with these sections.
pub fn html(introduction: &str, sections: &[Section<'_>]) -> String {
    let page = html! {
        (DOCTYPE)
        html lang="en" {
            head {
                meta charset="utf-8";
                meta name="viewport" content="width=device-width, initial-scale=1";
                title { "Speed against error" }
                style { (PreEscaped(STYLE)) }
            }
            body {
                header { h1 { "Speed against error" } p { (introduction) } }
                main {
                    @for section in sections {
                        section { h2 { (section.title) } @for part in &section.blocks { (block(part)) } }
                    }
                }
                footer { p { "Made by tcgs " (env!("CARGO_PKG_VERSION")) " bench report. Figures are of the decoded files on held-out views unless a table says otherwise." } }
            }
        }
    };
    page.into_string()
}

fn block(block: &Block<'_>) -> Markup {
    match block {
        Block::Heading(text) => html! { h3 { (text) } },
        Block::Note(text) => html! { p { (text) } },
        Block::List(items) => html! { ul { @for item in items { li { (item) } } } },
        Block::Table(content) => table(content),
        Block::Charts(plots) => {
            html! { div.charts { @for plot in *plots { (plot.chart.figure(&plot.caption)) } } }
        }
    }
}

fn table(table: &Table) -> Markup {
    html! {
        div.wide { table {
            thead { tr { @for cell in &table.head { th scope="col" { (cell) } } } }
            tbody {
                @for row in &table.rows {
                    tr.ours[row.is_own] { @for cell in &row.cells { td { (cell) } } }
                }
            }
        } }
    }
}
