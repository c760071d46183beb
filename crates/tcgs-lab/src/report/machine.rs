//! What a speed depends on besides the adapter: cores, load and other work on the machine.

use std::{fs, thread};

use serde::{Deserialize, Serialize};

/// The machine at some moment.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Machine {
    /// Cores that this process may use.
    pub cores: usize,
    /// Mean number of runnable processes over the last minute; `None` where the system does not tell.
    pub load: Option<f64>,
}

impl Machine {
    /// The machine now.
    pub fn now() -> Self {
        let cores = thread::available_parallelism().map_or(1, usize::from);
        let load = fs::read_to_string("/proc/loadavg").ok().and_then(|text| load_average(&text));
        Self { cores, load }
    }
}

/// The first figure of `/proc/loadavg`.
fn load_average(text: &str) -> Option<f64> {
    text.split_whitespace().next()?.parse().ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_load_is_the_first_figure() {
        assert_eq!(load_average("4.25 3.10 2.00 2/345 6789\n"), Some(4.25));
        assert_eq!(load_average(""), None);
    }
}
