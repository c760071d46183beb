//! The values of a query. Absent ones have a type, which PostgreSQL needs to know.

/// A value of a query.
#[derive(Debug, Clone, PartialEq)]
pub(in crate::store) enum Value {
    /// An integer.
    Int(Option<i64>),
    /// A number.
    Real(Option<f64>),
    Text(Option<String>),
    /// True or false; SQLite has 1 and 0.
    Bool(bool),
}

macro_rules! integers {
    ($($kind:ty),*) => {$(
        impl From<$kind> for Value {
            fn from(value: $kind) -> Self {
                Self::Int(Some(i64::from(value)))
            }
        }

        impl From<Option<$kind>> for Value {
            fn from(value: Option<$kind>) -> Self {
                Self::Int(value.map(i64::from))
            }
        }
    )*};
}

integers!(u8, u16, u32, i32, i64);

macro_rules! texts {
    ($($kind:ty),*) => {$(
        impl From<$kind> for Value {
            fn from(value: $kind) -> Self {
                Self::Text(Some(value.into()))
            }
        }
    )*};
}

texts!(String, &str, &String);

impl From<Option<String>> for Value {
    fn from(value: Option<String>) -> Self {
        Self::Text(value)
    }
}

impl From<&Option<String>> for Value {
    fn from(value: &Option<String>) -> Self {
        Self::Text(value.clone())
    }
}

impl From<f64> for Value {
    fn from(value: f64) -> Self {
        Self::Real(Some(value))
    }
}

impl From<Option<f64>> for Value {
    fn from(value: Option<f64>) -> Self {
        Self::Real(value)
    }
}

impl From<bool> for Value {
    fn from(value: bool) -> Self {
        Self::Bool(value)
    }
}

/// The values of [`Query::bind_all`](super::Query::bind_all), each of whatever kind a [`Value`] is made from.
macro_rules! values {
    ($($value:expr),+) => { [$($crate::store::sql::db::Value::from($value)),+] };
}

pub(in crate::store) use values;
