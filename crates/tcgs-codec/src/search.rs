//! The encoder's choice of contexts: those with the fewest bytes in the file.
//!
//! An attribute group can be coded with tables, or with networks of three kinds at three widths of weights; all groups together use at
//! most one set of planes. Widths and planes are chosen on a sample of chunks (all of them in a small scene), with the bytes of networks and
//! planes included. The remaining candidates, one of each kind, are coded whole, each also with a regression within the anchor, and compared
//! by their actual bytes.

use std::ops::Range;

use super::{
    attributes::CodedGroup,
    context::{
        AnchorContext, ContextChoice, ContextNetwork, ContextSearch, ContextSettings, GroupChoice,
        IntegerMlp, IntegerPlanes, RegressionSearch, WeightBits, quant_steps, regression, section,
    },
    decode::MAX_MULTIPLICATIONS,
    error::EncodeError,
    groups::GroupCoder,
    manifest::{GroupContext, GroupCosts, QuantSteps},
    quantize::Quantizer,
    regression_fit,
    shape::{Attribute, SceneShape},
};
use crate::domain::{
    AnchorScene, AttributeGroup, ContextCandidates, ContextFrame, Mlp,
    context_model::{ContextKind, GroupNetworks, NEIGHBORS},
};

/// Bits of a weight that are tried.
const WEIGHT_BITS: [u8; 3] = [8, 6, 4];

/// Chunks that widths and planes are chosen by.
const SAMPLE_CHUNKS: usize = 8;

/// Bytes of an entry in the section table, which every further section costs.
const SECTION_BYTES: u64 = super::container::TABLE_ENTRY as u64;

/// Anchors in file order, to be coded.
#[derive(Debug, Clone, Copy)]
pub(super) struct Anchors<'a> {
    pub(super) scene: &'a AnchorScene,
    pub(super) order: &'a [usize],
    pub(super) cells: &'a [[i32; 3]],
    pub(super) masks: &'a [bool],
    pub(super) shape: SceneShape,
    pub(super) steps: QuantSteps,
    pub(super) chunks: &'a [Range<usize>],
}

/// The chosen contexts, coded.
pub(super) struct Chosen {
    pub(super) choice: ContextChoice,
    pub(super) groups: [CodedGroup; 3],
    /// For the manifest.
    pub(super) contexts: [GroupContext; 3],
    /// The context section, where a group has a network.
    pub(super) context: Option<Vec<u8>>,
    /// The planes section, where a network samples planes.
    pub(super) planes: Option<Vec<u8>>,
    /// The regression section, where a group has one.
    pub(super) regression: Option<Vec<u8>>,
    /// Of each anchor, if a candidate uses them.
    pub(super) neighbors: Vec<[u32; NEIGHBORS]>,
}

/// Codes the groups as `settings` ask.
pub(super) fn choose(
    anchors: &Anchors<'_>,
    candidates: Option<&ContextCandidates>,
    settings: &ContextSettings,
) -> Result<Chosen, EncodeError> {
    let Some(candidates) = candidates else {
        let none = ContextCandidates {
            frame: ContextFrame { center: [0; 3], half: [1; 3] },
            static_steps: [0.0; 3],
            position: [None, None, None],
            planes: Vec::new(),
        };
        let context = AnchorContext::default();
        let choice = match settings.search {
            ContextSearch::Cheapest => ContextChoice::STATIC,
            ContextSearch::Fixed(choice) => choice,
        };
        return Search { anchors, candidates: &none, settings, context }.fixed(choice);
    };
    check(candidates, anchors.shape)?;
    let context = AnchorContext::new(&candidates.frame, anchors.cells);
    let mut search = Search { anchors, candidates, settings, context };
    match settings.search {
        ContextSearch::Cheapest => search.cheapest(),
        ContextSearch::Fixed(choice) => search.fixed(choice),
    }
}

/// Refuses candidates that do not fit the scene or that the format cannot state.
fn check(candidates: &ContextCandidates, shape: SceneShape) -> Result<(), EncodeError> {
    let unusable = |what: &str, problem: String| EncodeError::Candidate { what: what.to_owned(), problem };
    if let Some(half) = candidates.frame.half.iter().find(|half| **half == 0) {
        return Err(unusable("frame", format!("a half of {half} cells")));
    }
    // Were all groups to choose as large a network, the file would still be within the format.
    let share = MAX_MULTIPLICATIONS / 3 / shape.anchors.max(1) as u64;
    let check_networks = |networks: &GroupNetworks, kind: ContextKind, channels: usize| {
        for (attribute, network) in Attribute::ALL.into_iter().zip(networks) {
            let outputs = AttributeGroup::outputs(shape.channels(attribute));
            if let Some(network) = network {
                IntegerMlp::check(network, kind.inputs(channels), outputs)
                    .map_err(|text| unusable(&format!("{kind:?} network of {attribute:?}"), text))?;
                let each: u64 = network.layers.iter().map(|layer| layer.weights.len() as u64).sum();
                if each > share {
                    let text = format!("{each} weights where {share} are possible with so many anchors");
                    return Err(unusable(&format!("{kind:?} network of {attribute:?}"), text));
                }
            }
        }
        Ok::<(), EncodeError>(())
    };
    check_networks(&candidates.position, ContextKind::Position, 0)?;
    for (number, set) in candidates.planes.iter().enumerate() {
        IntegerPlanes::check(&set.planes).map_err(|text| unusable(&format!("planes {number}"), text))?;
        let channels = set.planes.plane_channels();
        check_networks(&set.own, ContextKind::TriPlane, channels)?;
        check_networks(&set.neighbors, ContextKind::TriPlaneKnn, channels)?;
    }
    Ok(())
}

/// A network at one width, with its estimated cost.
#[derive(Clone)]
struct Estimated {
    network: ContextNetwork,
    weight_bits: u8,
    bytes: u64,
}

/// A group coded one way.
struct CodedCandidate {
    choice: GroupChoice,
    coded: CodedGroup,
    /// Attributes, network and regression.
    bytes: u64,
    /// Attributes and network without a regression.
    base_bytes: u64,
}

struct Search<'a> {
    anchors: &'a Anchors<'a>,
    candidates: &'a ContextCandidates,
    settings: &'a ContextSettings,
    context: AnchorContext,
}

impl<'a> Search<'a> {
    fn coder(&self, attribute: Attribute) -> GroupCoder<'_> {
        let Anchors { scene, order, masks, shape, steps, chunks, .. } = *self.anchors;
        let quantizer = Quantizer { scene, order, attribute, base: steps.of(attribute) };
        GroupCoder { quantizer, shape, masks, chunks, anchors: &self.context }
    }

    fn with_tables(&self, attribute: Attribute) -> Result<CodedCandidate, EncodeError> {
        let group = attribute as usize;
        let coarser = i16::from(self.settings.coarser[group]);
        let step = i16::from(quant_steps::nearest_index(self.candidates.static_steps[group])) + coarser;
        let limit = i16::from(quant_steps::MAX_STEP_INDEX);
        let coded = self.coder(attribute).with_tables(step.clamp(-limit, limit) as i8)?;
        Ok(self.candidate(attribute, GroupChoice::Static, coded, 0))
    }

    fn with_network(
        &self,
        attribute: Attribute,
        network: ContextNetwork,
        weight_bits: u8,
    ) -> Result<CodedCandidate, EncodeError> {
        let choice = GroupChoice::Network { kind: network.kind, weight_bits };
        let own = network_bytes(&network);
        let coded = self.coder(attribute).with_network(network)?;
        Ok(self.candidate(attribute, choice, coded, own))
    }

    /// A coded group whose network takes `own` bytes, with a regression where that is smaller.
    fn candidate(
        &self,
        attribute: Attribute,
        choice: GroupChoice,
        coded: CodedGroup,
        own: u64,
    ) -> CodedCandidate {
        let base_bytes = coded.bytes() + own;
        let coder = self.coder(attribute);
        let regression = match self.settings.regression {
            RegressionSearch::Never => None,
            RegressionSearch::WhereItPays => regression_fit::fit(&coder, &coded),
        };
        let with = regression.map(|regression| coder.with_regression(&coded, regression));
        match with.map(|with| (with.bytes() + own, with)) {
            // As if this group alone had to pay for the section.
            Some((bytes, with)) if bytes + SECTION_BYTES < base_bytes => {
                CodedCandidate { choice, coded: with, bytes, base_bytes }
            }
            _ => CodedCandidate { choice, coded, bytes: base_bytes, base_bytes },
        }
    }

    fn quantized(
        &self,
        attribute: Attribute,
        mlp: &Mlp,
        kind: ContextKind,
        weight_bits: u8,
    ) -> Result<ContextNetwork, EncodeError> {
        let bits = WeightBits::new(weight_bits).ok_or_else(|| EncodeError::Candidate {
            what: "choice".to_owned(),
            problem: format!("{weight_bits} bits a weight"),
        })?;
        let mut mlp = IntegerMlp::quantize(mlp, bits);
        mlp.shift_last_output(quant_steps::index_as_octaves(*attribute.of(&self.settings.coarser)));
        Ok(ContextNetwork { kind, mlp })
    }

    /// The width with the lowest estimate for a network; `None` without a network, or if its steps do not suit the
    /// attributes.
    fn best_width(
        &self,
        attribute: Attribute,
        mlp: Option<&Mlp>,
        kind: ContextKind,
    ) -> Result<Option<Estimated>, EncodeError> {
        let Some(mlp) = mlp else { return Ok(None) };
        let stride = self.anchors.chunks.len().div_ceil(SAMPLE_CHUNKS);
        let mut best: Option<Estimated> = None;
        for weight_bits in WEIGHT_BITS {
            let network = self.quantized(attribute, mlp, kind, weight_bits)?;
            let bytes = match self.coder(attribute).estimate(&network, stride) {
                Ok(bytes) => bytes + network_bytes(&network),
                Err(EncodeError::OutOfRange { .. }) => continue,
                Err(other) => return Err(other),
            };
            if best.as_ref().is_none_or(|best| bytes < best.bytes) {
                best = Some(Estimated { network, weight_bits, bytes });
            }
        }
        Ok(best)
    }

    fn cheapest(&mut self) -> Result<Chosen, EncodeError> {
        let mut tried: [Vec<CodedCandidate>; 3] = Default::default();
        for attribute in Attribute::ALL {
            let tried = attribute.of_mut(&mut tried);
            tried.push(self.with_tables(attribute)?);
            let mlp = attribute.of(&self.candidates.position).as_ref();
            if let Some(found) = self.best_width(attribute, mlp, ContextKind::Position)? {
                self.try_network(attribute, found, tried)?;
            }
        }
        let without = std::array::from_fn(|group| fewest_bytes(&tried[group], Scope::NoPlanes));
        let mut planes = None;
        if let Some(PlanesEstimate { number, section, networks }) = self.best_planes(without)? {
            self.sample(number);
            for (attribute, found) in Attribute::ALL.into_iter().zip(networks) {
                for estimated in found {
                    self.try_network(attribute, estimated, attribute.of_mut(&mut tried))?;
                }
            }
            planes = Some((number, section));
        }
        let frame = section::encode(&self.candidates.frame, [None; 3]).len() as u64;
        let mut best = (u64::MAX, Scope::Tables);
        for scope in [Scope::Tables, Scope::NoPlanes, Scope::All] {
            let sections = match (scope, &planes) {
                (Scope::Tables, _) => 0,
                (Scope::NoPlanes, _) => SECTION_BYTES + frame,
                (Scope::All, Some((_, section))) => 2 * SECTION_BYTES + frame + section.len() as u64,
                (Scope::All, None) => continue,
            };
            let total = sections + tried.iter().map(|tried| fewest_bytes(tried, scope)).sum::<u64>();
            if total < best.0 {
                best = (total, scope);
            }
        }
        Ok(self.finish(planes.filter(|_| best.1 == Scope::All), tried, best.1))
    }

    /// Codes a candidate whole, unless its steps do not suit the attributes.
    fn try_network(
        &self,
        attribute: Attribute,
        found: Estimated,
        tried: &mut Vec<CodedCandidate>,
    ) -> Result<(), EncodeError> {
        match self.with_network(attribute, found.network, found.weight_bits) {
            Ok(network) => tried.push(network),
            Err(EncodeError::OutOfRange { .. }) => {}
            Err(other) => return Err(other),
        }
        Ok(())
    }

    /// Samples the planes of a set.
    fn sample(&mut self, number: usize) {
        let planes = IntegerPlanes::quantize(&self.candidates.planes[number].planes);
        self.context.sample(&planes.texels());
        let wants = |set: &GroupNetworks| set.iter().any(Option::is_some);
        if wants(&self.candidates.planes[number].neighbors) && !self.context.has_neighbors() {
            self.context.find_neighbors(self.anchors.cells);
        }
    }

    /// The planes with the lowest estimate, if any group could gain from them.
    fn best_planes(&mut self, without: [u64; 3]) -> Result<Option<PlanesEstimate>, EncodeError> {
        let mut best = None;
        let mut least_total = u64::MAX;
        let candidates = self.candidates;
        for (number, set) in candidates.planes.iter().enumerate() {
            let section = IntegerPlanes::quantize(&set.planes).encode();
            self.sample(number);
            let mut networks: [Vec<Estimated>; 3] = Default::default();
            let mut total = section.len() as u64;
            for attribute in Attribute::ALL {
                let kinds = [
                    (attribute.of(&set.own).as_ref(), ContextKind::TriPlane),
                    (attribute.of(&set.neighbors).as_ref(), ContextKind::TriPlaneKnn),
                ];
                let estimated = attribute.of_mut(&mut networks);
                for (mlp, kind) in kinds {
                    estimated.extend(self.best_width(attribute, mlp, kind)?);
                }
                total +=
                    estimated.iter().map(|network| network.bytes).fold(*attribute.of(&without), u64::min);
            }
            if total < least_total {
                least_total = total;
                best = Some(PlanesEstimate { number, section, networks });
            }
        }
        Ok(best)
    }

    fn fixed(&mut self, choice: ContextChoice) -> Result<Chosen, EncodeError> {
        let unusable = |problem: String| EncodeError::Candidate { what: "choice".to_owned(), problem };
        let kinds = kinds(&choice);
        let sampled = kinds.iter().flatten().any(|kind| kind.sampled() > 0);
        let candidates = self.candidates;
        let set = match choice.planes {
            Some(number) if sampled => Some(
                candidates
                    .planes
                    .get(number)
                    .ok_or_else(|| unusable(format!("there are no planes {number}")))?,
            ),
            _ => None,
        };
        let mut section = None;
        if let Some(set) = set {
            let planes = IntegerPlanes::quantize(&set.planes);
            section = Some(planes.encode());
            self.context.sample(&planes.texels());
            if kinds.contains(&Some(ContextKind::TriPlaneKnn)) {
                self.context.find_neighbors(self.anchors.cells);
            }
        }
        let mut tried: [Vec<CodedCandidate>; 3] = Default::default();
        for attribute in Attribute::ALL {
            let group = attribute as usize;
            let GroupChoice::Network { kind, weight_bits } = choice.groups[group] else {
                tried[group].push(self.with_tables(attribute)?);
                continue;
            };
            let networks = match kind {
                ContextKind::Position => Some(&candidates.position),
                ContextKind::TriPlane => set.map(|set| &set.own),
                ContextKind::TriPlaneKnn => set.map(|set| &set.neighbors),
            };
            let mlp = networks
                .and_then(|networks| networks[group].as_ref())
                .ok_or_else(|| unusable(format!("there is no {kind:?} network of {attribute:?}")))?;
            let network = self.quantized(attribute, mlp, kind, weight_bits)?;
            tried[group].push(self.with_network(attribute, network, weight_bits)?);
        }
        Ok(self.finish(choice.planes.zip(section), tried, Scope::All))
    }

    /// Takes the cheapest of each group.
    fn finish(
        &mut self,
        planes: Option<(usize, Vec<u8>)>,
        tried: [Vec<CodedCandidate>; 3],
        scope: Scope,
    ) -> Chosen {
        let chosen = tried.map(|tried| {
            let mut costs = GroupCosts::default();
            for tried in &tried {
                let cost = match tried.choice {
                    GroupChoice::Static => &mut costs.tables,
                    GroupChoice::Network { kind: ContextKind::Position, .. } => &mut costs.position,
                    GroupChoice::Network { kind: ContextKind::TriPlane, .. } => &mut costs.tri_plane,
                    GroupChoice::Network { kind: ContextKind::TriPlaneKnn, .. } => &mut costs.tri_plane_knn,
                };
                *cost = Some(tried.base_bytes);
            }
            let allowed = tried.into_iter().filter(|tried| scope.allows(tried.choice));
            let best = allowed.min_by_key(|tried| tried.bytes).expect("every group was coded in some way");
            (best.choice, best.coded, costs)
        });
        let (planes, section) = planes.unzip();
        let choice = ContextChoice { planes, groups: std::array::from_fn(|group| chosen[group].0) };
        let kinds = kinds(&choice);
        let contexts =
            std::array::from_fn(|group| GroupContext { kind: kinds[group], bytes: chosen[group].2 });
        let groups = chosen.map(|(_, coded, _)| coded);
        let networks = std::array::from_fn(|group: usize| groups[group].network());
        let context =
            kinds.iter().any(Option::is_some).then(|| section::encode(&self.candidates.frame, networks));
        let regression = regression::encode(groups.each_ref().map(|group| group.model.regression.as_ref()));
        let neighbors = self.context.take_neighbors();
        Chosen { choice, contexts, context, planes: section, regression, groups, neighbors }
    }
}

/// Which candidates a file may use.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Scope {
    /// Tables.
    Tables,
    /// And networks that are given the position alone.
    NoPlanes,
    /// And those that sample planes.
    All,
}

impl Scope {
    fn allows(self, choice: GroupChoice) -> bool {
        match choice {
            GroupChoice::Static => true,
            GroupChoice::Network { kind: ContextKind::Position, .. } => self != Scope::Tables,
            GroupChoice::Network { .. } => self == Scope::All,
        }
    }
}

/// Planes that may be chosen.
struct PlanesEstimate {
    /// Among the candidates.
    number: usize,
    section: Vec<u8>,
    /// Networks of each group that use them.
    networks: [Vec<Estimated>; 3],
}

/// Bytes of the cheapest candidate in scope.
fn fewest_bytes(tried: &[CodedCandidate], scope: Scope) -> u64 {
    let allowed = tried.iter().filter(|tried| scope.allows(tried.choice));
    allowed.map(|tried| tried.bytes).min().unwrap_or(u64::MAX)
}

/// Bytes of a network in the context section, with its length.
fn network_bytes(network: &ContextNetwork) -> u64 {
    let frame = ContextFrame { center: [0; 3], half: [1; 3] };
    let of = |networks| section::encode(&frame, networks).len() as u64;
    of([Some(network), None, None]) - of([None; 3])
}

fn kinds(choice: &ContextChoice) -> [Option<ContextKind>; 3] {
    choice.groups.map(|choice| match choice {
        GroupChoice::Static => None,
        GroupChoice::Network { kind, .. } => Some(kind),
    })
}
