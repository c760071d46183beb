//! A statement with its values.

use std::{borrow::Cow, fmt::Write as _};

use sqlx::{
    AssertSqlSafe, Postgres, Sqlite, postgres::PgArguments, query::Query as Bound, sqlite::SqliteArguments,
};

use super::Value;

/// A statement, or a part of one, in the spelling of each database.
#[derive(Debug, Clone, Copy)]
pub(in crate::store) struct Sql {
    pub(in crate::store) sqlite: &'static str,
    /// For PostgreSQL.
    pub(in crate::store) postgres: &'static str,
}

impl From<&'static str> for Sql {
    fn from(text: &'static str) -> Self {
        Self { sqlite: text, postgres: text }
    }
}

/// A statement with its values.
#[derive(Debug, Clone)]
pub(in crate::store) struct Query {
    sqlite: Cow<'static, str>,
    postgres: Cow<'static, str>,
    values: Vec<Value>,
}

/// A query of this statement, without values yet.
pub(in crate::store) fn query(sql: impl Into<Sql>) -> Query {
    let Sql { sqlite, postgres } = sql.into();
    Query { sqlite: sqlite.into(), postgres: postgres.into(), values: Vec::new() }
}

impl Query {
    /// Adds the next value.
    pub(in crate::store) fn bind(mut self, value: impl Into<Value>) -> Self {
        self.values.push(value.into());
        self
    }

    /// Adds the next values, as [`values`](super::values) makes them.
    pub(in crate::store) fn bind_all(mut self, values: impl IntoIterator<Item = Value>) -> Self {
        self.values.extend(values);
        self
    }

    /// Continues the statement's text.
    pub(in crate::store) fn push(&mut self, sql: impl Into<Sql>) -> &mut Self {
        let Sql { sqlite, postgres } = sql.into();
        self.sqlite.to_mut().push_str(sqlite);
        self.postgres.to_mut().push_str(postgres);
        self
    }

    /// Continues the statement with a value. Not for statements that number their values.
    pub(in crate::store) fn push_bind(&mut self, value: impl Into<Value>) -> &mut Self {
        self.values.push(value.into());
        self.push("?")
    }

    /// Continues the statement with a condition on a value, if there is one; the condition ends where the value goes.
    pub(in crate::store) fn push_if(&mut self, condition: &'static str, value: Option<impl Into<Value>>) {
        if let Some(value) = value {
            self.push(condition).push_bind(value);
        }
    }

    /// Locks the rows that it reads until the transaction ends; SQLite's writers hold the whole database.
    pub(in crate::store) fn for_update(mut self) -> Self {
        self.push(Sql { sqlite: "", postgres: " FOR UPDATE" });
        self
    }

    /// As [`Query::for_update`], of the rows of one table of a join only.
    pub(in crate::store) fn for_update_of(mut self, table: &'static str) -> Self {
        self.push(Sql { sqlite: "", postgres: " FOR UPDATE OF " }).push(Sql { sqlite: "", postgres: table });
        self
    }

    /// As SQLite's driver takes it.
    pub(super) fn sqlite(self) -> Bound<'static, Sqlite, SqliteArguments> {
        let query = match self.sqlite {
            Cow::Borrowed(text) => sqlx::query(text),
            Cow::Owned(text) => sqlx::query(AssertSqlSafe(text)),
        };
        self.values.into_iter().fold(query, |query, value| match value {
            Value::Int(value) => query.bind(value),
            Value::Real(value) => query.bind(value),
            Value::Text(value) => query.bind(value),
            Value::Bool(value) => query.bind(value),
        })
    }

    /// As PostgreSQL's driver takes it.
    pub(super) fn postgres(self) -> Bound<'static, Postgres, PgArguments> {
        let query = sqlx::query(AssertSqlSafe(numbered(&self.postgres)));
        self.values.into_iter().fold(query, |query, value| match value {
            Value::Int(value) => query.bind(value),
            Value::Real(value) => query.bind(value),
            Value::Text(value) => query.bind(value.map(without_nul)),
            Value::Bool(value) => query.bind(value),
        })
    }

    /// Continues with a text of a test.
    #[cfg(test)]
    pub(in crate::store) fn push_text(&mut self, text: &str) {
        self.sqlite.to_mut().push_str(text);
        self.postgres.to_mut().push_str(text);
    }

    /// The text for each database, for its plan.
    #[cfg(test)]
    pub(in crate::store) fn texts(&self) -> (String, String) {
        (self.sqlite.to_string(), numbered(&self.postgres))
    }
}

/// A text as PostgreSQL takes it: with U+FFFD for U+0000, which its texts cannot have.
fn without_nul(text: String) -> String {
    if text.contains('\0') { text.replace('\0', "\u{fffd}") } else { text }
}

/// A text with its values named `$1` as PostgreSQL has them: `?1` is `$1`, and the n-th `?` without a number is `$n`.
fn numbered(text: &str) -> String {
    let mut parts = text.split('?');
    let mut numbered = parts.next().unwrap_or_default().to_owned();
    for (index, part) in parts.enumerate() {
        numbered.push('$');
        if !part.starts_with(|character: char| character.is_ascii_digit()) {
            // Writing into a string cannot fail.
            let _ = write!(numbered, "{}", index + 1);
        }
        numbered.push_str(part);
    }
    numbered
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn values_are_numbered_for_postgres() {
        for (text, expected) in [
            ("SELECT 1", "SELECT 1"),
            ("a = ? AND b = ?", "a = $1 AND b = $2"),
            ("a = ?2 AND b = ?1 OR c = ?2", "a = $2 AND b = $1 OR c = $2"),
            ("(?, ?)", "($1, $2)"),
            ("?", "$1"),
        ] {
            assert_eq!(numbered(text), expected);
        }
        let mut built = query("SELECT * FROM jobs WHERE true");
        built.push(" AND a = ").push_bind(1_i64).push(" AND b IN (").push_bind("x").push(")");
        let (sqlite, postgres) = built.texts();
        assert_eq!(sqlite, "SELECT * FROM jobs WHERE true AND a = ? AND b IN (?)");
        assert_eq!(postgres, "SELECT * FROM jobs WHERE true AND a = $1 AND b IN ($2)");
    }
}
