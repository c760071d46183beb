//! What the value of an option is, and how JSON states it.

use std::fmt;

use serde_json::Value;

/// What an option's value is, and its bounds.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum OptionKind {
    /// One of these names.
    Choice(&'static [&'static str]),
    /// A set of these names, separated by commas.
    Choices(&'static [&'static str]),
    /// A whole number from the first to the second.
    Integer(u64, u64),
    /// A whole number of bytes, which the command line also takes with a unit.
    Bytes,
    /// A positive number.
    Positive,
    /// At most this number of different positive numbers, separated by commas, perhaps in brackets.
    Positives(usize),
    /// One of these names, or a positive number.
    ChoiceOrPositive(&'static [&'static str]),
    /// One of these names, or the path of a folder in the dataset.
    ChoiceOrFolder(&'static [&'static str]),
    /// One of these names, or six numbers separated by commas: two corners of a box.
    ChoiceOrBox(&'static [&'static str]),
    /// True or false.
    Switch,
}

impl fmt::Display for OptionKind {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            OptionKind::Choice(names) => write!(f, "one of {}", names.join(", ")),
            OptionKind::Choices(names) => write!(f, "a list of {}", names.join(", ")),
            OptionKind::Integer(min, max) => write!(f, "a whole number in {min}..={max}"),
            OptionKind::Bytes => f.write_str("a whole number of bytes"),
            OptionKind::Positive => f.write_str("a positive number"),
            OptionKind::Positives(max) => write!(f, "a list of at most {max} positive numbers"),
            OptionKind::ChoiceOrPositive(names) => write!(f, "{} or a positive number", names.join(", ")),
            OptionKind::ChoiceOrFolder(names) => {
                write!(f, "{} or the path of a folder in the dataset", names.join(", "))
            }
            OptionKind::ChoiceOrBox(names) => {
                write!(f, "{} or a box x0,y0,z0,x1,y1,z1", names.join(", "))
            }
            OptionKind::Switch => f.write_str("true or false"),
        }
    }
}

impl OptionKind {
    pub(super) fn is_list(self) -> bool {
        matches!(self, OptionKind::Choices(_) | OptionKind::Positives(_))
    }

    /// A value of this kind in JSON as it would stand in a query string; `None` for a value of another kind.
    pub(super) fn text_of(self, value: &Value) -> Option<String> {
        let one = |value: &Value| match (self, value) {
            (
                OptionKind::Choice(_)
                | OptionKind::Choices(_)
                | OptionKind::ChoiceOrFolder(_)
                | OptionKind::ChoiceOrBox(_),
                Value::String(text),
            ) => Some(text.clone()),
            (OptionKind::ChoiceOrPositive(names), Value::String(text)) => {
                names.contains(&text.as_str()).then(|| text.clone())
            }
            (OptionKind::Switch, Value::Bool(value)) => Some(value.to_string()),
            (
                OptionKind::Choice(_)
                | OptionKind::Choices(_)
                | OptionKind::ChoiceOrFolder(_)
                | OptionKind::ChoiceOrBox(_)
                | OptionKind::Switch,
                _,
            ) => None,
            (_, Value::Number(number)) => Some(number.to_string()),
            _ => None,
        };
        match value {
            Value::Array(items) if self.is_list() && !items.is_empty() => {
                // An empty name would be left out, and one with a comma in it would become two.
                let item = |value| one(value).filter(|text| !text.is_empty() && !text.contains(','));
                items.iter().map(item).collect::<Option<Vec<_>>>().map(|items| items.join(","))
            }
            Value::String(text) if self.is_list() => Some(text.clone()),
            _ if self.is_list() => None,
            value => one(value),
        }
    }
}
