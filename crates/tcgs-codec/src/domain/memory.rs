//! Memory limits, and byte sizes with units.

use std::fmt;

/// Default limit of device memory on adapters with memory of their own. wgpu does not report how much there is; cards that are
/// worth training on have this much.
pub const DEFAULT_DEVICE_BYTES: u64 = 8 << 30;

/// Limits set by the user.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct MemoryLimits {
    /// Bytes of main memory; adapters without memory of their own take theirs from it unless `gpu` is set.
    pub host: u64,
    /// Bytes of buffers on the device, if set.
    pub gpu: Option<u64>,
}

impl MemoryLimits {
    /// No limit.
    pub const NONE: Self = Self { host: u64::MAX, gpu: Some(u64::MAX) };

    /// The limits on an adapter. One that shares main memory gets half of it unless `gpu` is set.
    #[must_use]
    pub fn budget(&self, shares_main_memory: bool) -> MemoryBudget {
        match self.gpu {
            Some(gpu) => MemoryBudget { host: self.host, gpu },
            None if shares_main_memory => MemoryBudget { host: self.host / 2, gpu: self.host / 2 },
            None => MemoryBudget { host: self.host, gpu: DEFAULT_DEVICE_BYTES },
        }
    }
}

/// Memory that a run may use.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct MemoryBudget {
    /// Bytes of main memory besides the device's.
    pub host: u64,
    /// Bytes of buffers on the device.
    pub gpu: u64,
}

/// A number of bytes, displayed with a unit and one decimal.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub struct Bytes(pub u64);

const UNITS: [(&str, u32); 4] = [("TiB", 40), ("GiB", 30), ("MiB", 20), ("KiB", 10)];

impl fmt::Display for Bytes {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match UNITS.iter().find(|(_, shift)| self.0 >> shift > 0) {
            Some((unit, shift)) => write!(f, "{:.1} {unit}", self.0 as f64 / (1_u64 << shift) as f64),
            None => write!(f, "{} bytes", self.0),
        }
    }
}

impl std::str::FromStr for Bytes {
    type Err = String;

    /// A whole number of bytes, or a number with one of the units KiB, MiB, GiB, TiB (or K, M, G, T, the same) and kB,
    /// MB, GB, TB (powers of ten), in any case.
    fn from_str(text: &str) -> Result<Self, String> {
        let error = || format!("'{text}' is not a number of bytes such as 4GiB, 500MB or 1073741824");
        let text = text.trim();
        let end = text.find(|c: char| !c.is_ascii_digit() && c != '.').unwrap_or(text.len());
        let (number, unit) = text.split_at(end);
        let factor: u64 = match unit.trim().to_ascii_lowercase().as_str() {
            "" | "b" => 1,
            "k" | "kib" => 1 << 10,
            "m" | "mib" => 1 << 20,
            "g" | "gib" => 1 << 30,
            "t" | "tib" => 1 << 40,
            "kb" => 1_000,
            "mb" => 1_000_000,
            "gb" => 1_000_000_000,
            "tb" => 1_000_000_000_000,
            _ => return Err(error()),
        };
        let bytes = match number.parse::<u64>() {
            Ok(whole) => whole.checked_mul(factor),
            // The largest f64 below 2^64 still converts exactly.
            Err(_) => number
                .parse::<f64>()
                .ok()
                .map(|part| part * factor as f64)
                .filter(|bytes| *bytes < u64::MAX as f64)
                .map(|bytes| bytes as u64),
        };
        bytes.filter(|bytes| *bytes > 0).map(Self).ok_or_else(error)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bytes_are_read_as_people_write_them() {
        let gib = 1 << 30;
        for (text, bytes) in [
            ("1073741824", gib),
            ("4GiB", 4 * gib),
            (" 4 gib ", 4 * gib),
            ("1.5G", 3 * gib / 2),
            ("500MB", 500_000_000),
            ("2k", 2048),
            ("3TB", 3_000_000_000_000),
        ] {
            assert_eq!(text.parse(), Ok(Bytes(bytes)), "{text}");
        }
        for text in ["", "GiB", "-1", "0", "4 GX", "1e9", "1.2.3GiB", "99999999999999999999", "99999999999T"]
        {
            assert!(text.parse::<Bytes>().is_err(), "{text}");
        }
        let shown = [0, 1023, 1024, 1536 << 20, 8 << 40].map(|bytes| Bytes(bytes).to_string());
        assert_eq!(shown, ["0 bytes", "1023 bytes", "1.0 KiB", "1.5 GiB", "8.0 TiB"]);
    }

    #[test]
    fn an_adapter_without_its_own_memory_shares_what_there_is() {
        let limits = MemoryLimits { host: 800, gpu: None };
        assert_eq!(limits.budget(true), MemoryBudget { host: 400, gpu: 400 });
        assert_eq!(limits.budget(false), MemoryBudget { host: 800, gpu: DEFAULT_DEVICE_BYTES });
        let stated = MemoryLimits { gpu: Some(300), ..limits };
        assert_eq!(stated.budget(true), MemoryBudget { host: 800, gpu: 300 });
    }
}
