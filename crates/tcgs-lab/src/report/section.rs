//! What a report is made of: sections of tables, notes and charts. [`super::page`] and [`super::markdown`] write them.

use super::plots::Plot;

/// Stands for a figure that there is not.
pub const NONE: &str = "–";

/// A part of a report under its title.
#[derive(Debug)]
pub struct Section<'a> {
    pub title: &'static str,
    pub blocks: Vec<Block<'a>>,
}

#[derive(Debug)]
pub enum Block<'a> {
    Heading(String),
    Note(String),
    List(Vec<String>),
    Table(Table),
    Charts(&'a [Plot]),
}

/// A table of texts.
#[derive(Debug)]
pub struct Table {
    pub head: Vec<String>,
    pub rows: Vec<Row>,
}

#[derive(Debug)]
pub struct Row {
    pub cells: Vec<String>,
    /// Whether it stands out among rows of other origin.
    pub is_own: bool,
}

impl Table {
    /// A table without the columns that have no figure in any row.
    pub fn new(head: Vec<String>, rows: impl IntoIterator<Item = Vec<String>>) -> Self {
        let rows = rows.into_iter().map(|cells| Row { cells, is_own: false }).collect();
        Self { head, rows }.without_empty_columns()
    }

    fn without_empty_columns(mut self) -> Self {
        let is_kept: Vec<bool> = (0..self.head.len())
            .map(|at| {
                self.rows.is_empty()
                    || self.rows.iter().any(|row| row.cells.get(at).is_none_or(|cell| cell != NONE))
            })
            .collect();
        let keep = |cells: &mut Vec<String>| {
            let mut kept = is_kept.iter();
            cells.retain(|_| kept.next().copied().unwrap_or(true));
        };
        keep(&mut self.head);
        self.rows.iter_mut().for_each(|row| keep(&mut row.cells));
        self
    }
}

pub fn texts(names: &[&str]) -> Vec<String> {
    names.iter().map(|name| (*name).to_owned()).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_column_without_any_figure_is_left_out() {
        let rows = [texts(&["chair", NONE, NONE]), texts(&["fox", NONE, "3"])];
        let table = Table::new(texts(&["set", "LPIPS", "bytes"]), rows);
        assert_eq!(table.head, ["set", "bytes"]);
        assert_eq!(table.rows[0].cells, ["chair", NONE]);
        assert_eq!(table.rows[1].cells, ["fox", "3"]);
        assert_eq!(Table::new(texts(&["set"]), []).head, ["set"], "an empty table keeps its head");
    }
}
