//! A report's tables as Markdown, and the place in a document where they go.

use super::section::{Block, Row, Section, Table};

/// The lines around the part of a document that a report rewrites.
const MARKERS: [&str; 2] = ["<!-- report: begin -->", "<!-- report: end -->"];

/// The sections that have more than charts.
pub fn text(introduction: &str, sections: &[Section<'_>]) -> String {
    let mut parts = vec![introduction.to_owned()];
    for section in sections {
        let blocks: Vec<String> = section.blocks.iter().filter_map(block).collect();
        if !blocks.is_empty() {
            parts.push(format!("### {}", section.title));
            parts.extend(blocks);
        }
    }
    parts.join("\n\n") + "\n"
}

fn block(block: &Block<'_>) -> Option<String> {
    match block {
        Block::Heading(text) => Some(format!("#### {text}")),
        Block::Note(text) => Some(text.clone()),
        Block::List(items) => {
            Some(items.iter().map(|item| format!("- {item}")).collect::<Vec<_>>().join("\n"))
        }
        Block::Table(content) => Some(table(content)),
        Block::Charts(_) => None,
    }
}

fn table(table: &Table) -> String {
    let line =
        |cells: &mut dyn Iterator<Item = String>| format!("| {} |", cells.collect::<Vec<_>>().join(" | "));
    let escaped = |cell: &String| cell.replace('|', "\\|");
    let rule =
        (0..table.head.len()).map(|at| if is_of_figures(table, at) { "--:" } else { "---" }.to_owned());
    let mut lines = vec![line(&mut table.head.iter().map(escaped)), line(&mut { rule })];
    lines.extend(table.rows.iter().map(|Row { cells, is_own }| {
        line(
            &mut cells
                .iter()
                .map(|cell| if *is_own { format!("**{}**", escaped(cell)) } else { escaped(cell) }),
        )
    }));
    lines.join("\n")
}

/// Whether a column has figures, which are aligned to the right.
fn is_of_figures(table: &Table, at: usize) -> bool {
    let mut cells = table.rows.iter().filter_map(|row| row.cells.get(at)).peekable();
    cells.peek().is_some()
        && cells.all(|cell| cell.chars().all(|c| c.is_ascii_digit() || " +-–±.e*".contains(c)))
}

/// The document with `tables` between its markers, or which marker is missing.
pub fn rewrite(document: &str, tables: &str) -> Result<String, String> {
    let [begin, end] = MARKERS;
    let missing = |marker: &str| format!("the line '{marker}' is missing");
    let (before, rest) = document.split_once(begin).ok_or_else(|| missing(begin))?;
    let (_, after) = rest.split_once(end).ok_or_else(|| missing(end))?;
    Ok(format!("{before}{begin}\n\n{}\n\n{end}{after}", tables.trim()))
}

#[cfg(test)]
mod tests {
    use super::{super::section::texts, *};

    #[test]
    fn tables_are_written_with_figures_to_the_right_and_charts_left_out() {
        let rows = [texts(&["chair", "a|b", "27.51 ± 0.12"]), texts(&["fox", "c", "–"])];
        let mut table = Table::new(texts(&["set", "model", "PSNR dB"]), rows);
        table.rows[1].is_own = true;
        let sections = [
            Section { title: "Runs", blocks: vec![Block::Table(table), Block::Note("A note.".to_owned())] },
            Section { title: "Only charts", blocks: vec![Block::Charts(&[])] },
        ];
        let expected = "Two runs.\n\n### Runs\n\n\
            | set | model | PSNR dB |\n| --- | --- | --: |\n\
            | chair | a\\|b | 27.51 ± 0.12 |\n| **fox** | **c** | **–** |\n\nA note.\n";
        assert_eq!(text("Two runs.", &sections), expected);
    }

    #[test]
    fn what_is_around_the_markers_is_kept() {
        let document = "before\n<!-- report: begin -->\nold\n<!-- report: end -->\nafter\n";
        let once = rewrite(document, "new\n").expect("a place");
        assert_eq!(once, "before\n<!-- report: begin -->\n\nnew\n\n<!-- report: end -->\nafter\n");
        assert_eq!(rewrite(&once, "new"), Ok(once.clone()), "the same tables change nothing");
        assert!(rewrite("no place", "new").expect_err("refused").contains("begin"));
        assert!(rewrite("<!-- report: begin -->", "new").expect_err("refused").contains("end"));
    }
}
