//! Enumerations whose variants have the names that users write.

/// Declares an enumeration with a name for each variant: `ALL`, `NAMES`, `name`, `Display`, `FromStr` and serde all go by these names.
#[macro_export]
#[doc(hidden)]
macro_rules! named_choice {
    ($(#[$meta:meta])* $vis:vis enum $name:ident { $($(#[$variant_meta:meta])* $variant:ident = $text:literal),+ $(,)? }) => {
        $(#[$meta])*
        #[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, serde::Serialize, serde::Deserialize)]
        $vis enum $name { $($(#[$variant_meta])* #[serde(rename = $text)] $variant),+ }

        impl $name {
            /// Every choice.
            $vis const ALL: [Self; [$($text),+].len()] = [$(Self::$variant),+];
            /// The name of every choice.
            $vis const NAMES: &[&str] = &[$($text),+];

            /// The name that users write.
            #[must_use]
            $vis fn name(self) -> &'static str {
                match self { $(Self::$variant => $text),+ }
            }
        }

        impl std::fmt::Display for $name {
            fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
                f.pad(self.name())
            }
        }

        impl std::str::FromStr for $name {
            type Err = String;

            fn from_str(text: &str) -> Result<Self, String> {
                let choice = Self::ALL.iter().copied().find(|choice| choice.name() == text);
                choice.ok_or_else(|| format!("'{text}' is not one of {}", Self::NAMES.join(", ")))
            }
        }
    };
}
pub(super) use named_choice;
