//! One way to run statements on SQLite and on PostgreSQL: queries with their values, rows, pools and transactions.
//!
//! Statements name their values `?` or `?1`, both spelled for SQLite and numbered for PostgreSQL here. A statement that the two databases
//! spell differently is a [`Sql`] with both texts; no statement has a question mark for anything else. Integers are 64 bits wide in both.

mod query;
mod row;
mod target;
mod value;

pub(super) use query::{Query, Sql, query};
pub(super) use row::Row;
pub(super) use target::{Pool, Target, Transaction};
pub(super) use value::{Value, values};
