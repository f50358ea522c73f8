// The two halves of a step in which particles take part, each in one pass over them: `send` is
// finiteness, stress and P2G, `receive` is G2P, motion, deformation and return mapping. The
// formulas are those of `pgjax/exchange.py`, which is the reference.
//
// A group of particles is turned over, so that a law sees vectors of the same number of each.
#pragma once

#include "laws.h"
#include "transfer.h"

namespace pgjax {

// What `send` counts, in the order of `EVENTS` in exchange.py.
enum Event { kNonfinite, kOutOfDomain, kInverted, kClamped, kEvents };
using Count = std::int32_t;

// One number for all particles, or one for each.
template <class T>
struct Parameter {
  const T* data;
  Index step;
  T at(Index p) const { return data[p * step]; }
};

// NaN unless all N numbers are finite, else 0.
template <int N, class T>
PGJAX_INLINE T zero_if_finite(const T* x) {
  T rest = 0;
  constexpr int kWhole = N / kChannels * kChannels;
  for (int i = kWhole; i < N; ++i) rest += x[i] * 0;
  if constexpr (kWhole > 0) {
    Vec<T> sum = {};
    for (int i = 0; i < kWhole; i += kChannels) sum += load(x + i) * 0;
    rest += (sum[0] + sum[1]) + (sum[2] + sum[3]);
  }
  return rest;
}

// A group of particles: row e holds number e of each.
template <class T, int Rows>
struct Block {
  alignas(kVectorBytes) T row[Rows][kGroup<T>];

  PGJAX_INLINE void put(int lane, int first, const T* x, int count) {
    for (int e = 0; e < count; ++e) row[first + e][lane] = x[e];
  }
  PGJAX_INLINE void take(int lane, int first, T* x, int count) const {
    for (int e = 0; e < count; ++e) x[e] = row[first + e][lane];
  }
  PGJAX_INLINE Group<T>* vectors(int first = 0) {
    return reinterpret_cast<Group<T>*>(row[first]);
  }
};

// Stress laws: from H, mu, lam to tau, J - 1 and what else `clamped` looks at.
template <class T>
struct NeoHookean {
  static constexpr int kMade = 10;
  PGJAX_INLINE static void stress(const Group<T>* in, Group<T>* out) { neo_hookean(in, out); }
  PGJAX_INLINE static bool clamped(const Block<T, kMade>& made, int lane) {
    return made.row[9][lane] <= T(kSmallestVolumeRatio) - 1;
  }
};
template <class T>
struct FixedCorotated {
  static constexpr int kMade = 10;
  PGJAX_INLINE static void stress(const Group<T>* in, Group<T>* out) { fixed_corotated(in, out); }
  PGJAX_INLINE static bool clamped(const Block<T, kMade>&, int) { return false; }
};
template <class T>
struct StVKHencky {
  static constexpr int kMade = 11;
  PGJAX_INLINE static void stress(const Group<T>* in, Group<T>* out) { stvk_hencky(in, out); }
  PGJAX_INLINE static bool clamped(const Block<T, kMade>& made, int lane) {
    return made.row[10][lane] < T(kSmallestStretch);
  }
};

// What `send` reads: arrays per particle, mass and volume among them; `parameters` are mu, lam.
template <class T>
struct Sender {
  Batched<const T> xi, position, v, C, He, H;
  Batched<const bool> alive, inside;
  Batched<const T> mass, volume, numbers, parameters[2];
  Index parameter_step[2];
  bool has_H;
};
template <class T>
struct Sent {
  Batched<T> g;
  Batched<bool> alive, finite;
  Batched<Count> events;
};

// What one particle contributes to its nodes, in units of cells.
template <class T, int D, bool Mls>
PGJAX_INLINE Coefficients<Vec<T>, D, !Mls> momentum_and_force(T mass, T h, T factor, const T* v,
                                                              const T* C, const T* tau) {
  // Column j of a D x D part of a matrix with rows of length `row`.
  const auto column = [](const T* A, int row, int j) {
    if constexpr (D == 3) return Vec<T>{A[j], A[row + j], A[2 * row + j], 0};
    return Vec<T>{A[j], A[row + j], 0, 0};
  };
  Coefficients<Vec<T>, D, !Mls> c;
  if constexpr (D == 3)
    c.A = Vec<T>{mass * v[0], mass * v[1], mass * v[2], mass};
  else
    c.A = Vec<T>{mass * v[0], mass * v[1], mass, 0};
#pragma GCC unroll 3
  for (int j = 0; j < D; ++j) {
    const Vec<T> flux = factor * column(tau, 3, j);
    c.B[j] = mass * h * column(C, D, j);
    if constexpr (Mls)
      c.B[j] += flux;
    else
      c.S[j] = flux;
  }
  return c;
}

template <class T, int D, int K, bool Mls, class Law>
void send(const Shape<D>& shape, Index batch, bool whole, const Sender<T>& in, const Sent<T>& out,
          Pool& pool) {
  constexpr int kSize = kGroup<T>;
  const auto strides = shape.strides();
  for_each_member(batch, pool, [&](Index b, Pool& pool) {
    const T *xi = in.xi.at(b), *position = in.position.at(b), *v = in.v.at(b), *C = in.C.at(b);
    const T *He = in.He.at(b), *H = in.H.at(b), *mass = in.mass.at(b), *volume = in.volume.at(b);
    const bool *alive = in.alive.at(b), *inside = in.inside.at(b);
    T* const nodes = out.g.at(b);
    bool *still_alive = out.alive.at(b), *all_finite = out.finite.at(b);
    if (whole)
      clear(nodes, shape.node_count() * kChannels * sizeof(T), pool);
    else
      clear_box(shape, touched<T, D, K>(shape, xi), nodes, pool);
    // Of a particle whose stencil is not in the array, against what was promised.
    clear(still_alive, shape.particles, pool);
    clear(all_finite, shape.particles, pool);
    const T dt = in.numbers.at(b)[0], h = in.numbers.at(b)[1], D_p = in.numbers.at(b)[2];
    const T factor = Mls ? -dt / D_p * h : -dt / h;
    const Parameter<T> mu{in.parameters[0].at(b), in.parameter_step[0]};
    const Parameter<T> lam{in.parameters[1].at(b), in.parameter_step[1]};
    std::atomic<Count> events[kEvents] = {};
    const auto send_group = [&](const std::int32_t* order, int count) {
      Block<T, 11> given;
      Block<T, Law::kMade> made;
      bool finite[kSize] = {};
      Count seen[kEvents] = {};
      std::memset(&given, 0, sizeof given);
      for (int l = 0; l < count; ++l) {
        const Index p = order[l];
        T zero = zero_if_finite<9>(He + 9 * p) + zero_if_finite<D>(position + D * p);
        zero += zero_if_finite<D * D>(C + D * D * p) + zero_if_finite<D>(v + D * p);
        if (in.has_H) zero += zero_if_finite<9>(H + 9 * p);
        finite[l] = zero == 0;
        if (finite[l] && alive[p] && inside[p]) given.put(l, 0, He + 9 * p, 9);
        given.row[9][l] = mu.at(p), given.row[10][l] = lam.at(p);
      }
      Law::stress(given.vectors(), made.vectors());
      for (int l = 0; l < count; ++l) {
        const Index p = order[l];
        T tau[9];
        made.take(l, 0, tau, 9);
        const bool stress_finite = zero_if_finite<9>(tau) == 0;
        const bool goes_on = alive[p] && inside[p] && finite[l] && stress_finite;
        all_finite[p] = finite[l], still_alive[p] = goes_on;
        seen[kNonfinite] += alive[p] && !(finite[l] && stress_finite);
        seen[kOutOfDomain] += alive[p] && finite[l] && !inside[p];
        if (!goes_on) continue;
        seen[kInverted] += made.row[9][l] <= -1, seen[kClamped] += Law::clamped(made, l);
        Index first[D] = {};
        T offset[D] = {};
        locate<T, D, K>(shape, xi + p * D, first, offset);
        Axis<T, K> axes[D];
        for (int i = 0; i < D; ++i) factors<T, K>(offset[i], axes[i]);
        const auto c = momentum_and_force<T, D, Mls>(mass[p], h, factor * volume[p], v + D * p,
                                                     C + D * D * p, tau);
        spread<T>(axes, widen(last_axis(axes[D - 1]), c), nodes + offset_of<D>(strides, first),
                  strides.data());
      }
      for (int e = 0; e < kEvents; ++e)
        if (seen[e]) events[e] += seen[e];
    };
    Columns<T, D, K>(shape, xi).for_each_group(pool, kSize, send_group);
    for (int e = 0; e < kEvents; ++e) out.events.at(b)[e] = events[e];
  });
}

enum Contact { kNone, kSticky, kSlip, kSeparating };

// The walls of a box: for the nodes along each direction, -1 behind the lower, 1 behind the upper.
// And the nodes that may have mass, the first and the end along each direction; no other is looked
// at or written. Without these numbers all may.
template <int D>
struct Walls {
  Contact contact = kNone;
  Batched<const std::int8_t> side[D];
  Batched<const std::int32_t> box;

  Box<D> box_at(const Index nodes[D], Index b) const {
    Box<D> all;
    for (int i = 0; i < D; ++i) {
      all.first[i] = box.data ? std::clamp<Index>(box.at(b)[i], 0, nodes[i]) : 0;
      all.end[i] = box.data ? std::clamp<Index>(box.at(b)[D + i], all.first[i], nodes[i]) : nodes[i];
    }
    return all;
  }
};

// What a wall across `axis` does to the velocity of a node (`contact.py`); `inward` is +-1.
template <int D, class T>
PGJAX_INLINE void touch(Contact contact, T friction, int axis, T inward, T v[D]) {
  const T normal_speed = inward * v[axis];
  if (contact == kSticky)
    for (int i = 0; i < D; ++i) v[i] = 0;
  if (contact == kSlip) v[axis] = 0;
  if (contact != kSeparating || !(normal_speed < 0)) return;
  v[axis] = 0;
  T square = 0;
  for (int i = 0; i < D; ++i) square += v[i] * v[i];
  const T speed = std::sqrt(square), left = square > 0 ? 1 + friction * normal_speed / speed : 1;
  for (int i = 0; i < D; ++i) v[i] *= left > 0 ? left : 0;
}

// Calls `one(node, sides)` for all nodes of a box of the grid, in chunks along the first directions:
// `sides` are those of the node, `node` its number. The chunk is the third argument.
template <int D, class F>
void for_each_node(const Index nodes[D], const Walls<D>& walls, Index b, Pool& pool, const F& one) {
  const bool bounded = walls.contact != kNone;
  const Box<D> box = walls.box_at(nodes, b);
  constexpr Index kRows = 64, last = D - 1;
  const Index rows = box.rows();
  pool.run((rows + kRows - 1) / kRows, [&](Index chunk) {
    const Index end = std::min(rows, (chunk + 1) * kRows);
    for (Index r = chunk * kRows; r < end; ++r) {
      Index place[D] = {};
      const Index row = box.row(nodes, r, place);
      std::array<int, D> sides = {};
      if (bounded)
        for (int i = 0; i < last; ++i) sides[i] = walls.side[i].at(b)[place[i]];
      for (Index k = box.first[last]; k < box.end[last]; ++k) {
        if (bounded) sides[last] = walls.side[last].at(b)[k];
        one(row * nodes[last] + k, sides, chunk);
      }
    }
  });
}
template <int D>
Index node_chunks(const Index nodes[D]) {
  Index rows = 1;
  for (int i = 0; i < D - 1; ++i) rows *= nodes[i];
  return rows / 64 + 1;
}

// From momentum and mass of a node to velocity and mass, in place: damping, gravity, walls; an empty
// node is at rest. `numbers` are what damping keeps and the D velocities that gravity adds.
template <class T, int D>
void velocities(const Index nodes[D], Index batch, const Walls<D>& walls, Batched<const T> from,
                Batched<const T> numbers, Batched<const T> friction, Batched<T> to, Pool& pool) {
  for_each_member(batch, pool, [&](Index b, Pool& pool) {
    const T *in = from.at(b), *number = numbers.at(b);
    const T mu = *friction.at(b);
    T* out = to.at(b);
    Vec<T> keeps = {}, gains = {};
    for (int i = 0; i < D; ++i) keeps[i] = number[0], gains[i] = number[0] * number[1 + i];
    for_each_node<D>(nodes, walls, b, pool, [&](Index n, const std::array<int, D>& sides, Index) {
      const Vec<T> node = load(in + n * kChannels);
      const T mass = node[D];
      Vec<T> v = mass > 0 ? node * (keeps / mass) + gains : Vec<T>{};
      v[D] = mass;
      store(out + n * kChannels, v);
      if (mass > 0)
        for (int i = 0; i < D; ++i)
          if (sides[i]) touch<D>(walls.contact, mu, i, T(-sides[i]), out + n * kChannels);
    });
  });
}

// The derivative of `touch` at v along (dv, dfriction), in place.
template <int D, class T>
PGJAX_INLINE void touch_tangent(Contact contact, T friction, T dfriction, int axis, T inward,
                                const T v[D], T dv[D]) {
  const T normal_speed = inward * v[axis], d_normal = inward * dv[axis];
  if (contact == kSticky)
    for (int i = 0; i < D; ++i) dv[i] = 0;
  if (contact == kSlip) dv[axis] = 0;
  if (contact != kSeparating || !(normal_speed < 0)) return;
  T square = 0, along = 0;
  for (int i = 0; i < D; ++i)
    if (i != axis) square += v[i] * v[i], along += v[i] * dv[i];
  dv[axis] = 0;
  if (!(square > 0)) return;
  const T speed = std::sqrt(square), left = 1 + friction * normal_speed / speed;
  const T change = (dfriction * normal_speed + friction * d_normal - friction * normal_speed * along / square) / speed;
  for (int i = 0; i < D; ++i)
    if (i != axis) dv[i] = left > 0 ? dv[i] * left + v[i] * change : 0;
}

// The derivative of `velocities` along (dfrom, dnumbers, dfriction).
template <class T, int D>
void velocities_tangent(const Index nodes[D], Index batch, const Walls<D>& walls,
                        Batched<const T> from, Batched<const T> numbers, Batched<const T> friction,
                        Batched<const T> dfrom, Batched<const T> dnumbers,
                        Batched<const T> dfriction, Batched<T> to, Pool& pool) {
  for_each_member(batch, pool, [&](Index b, Pool& pool) {
    const T *in = from.at(b), *number = numbers.at(b), *din = dfrom.at(b), *dnumber = dnumbers.at(b);
    const T kept = number[0], mu = *friction.at(b), dmu = *dfriction.at(b);
    T* out = to.at(b);
    for_each_node<D>(nodes, walls, b, pool, [&](Index n, const std::array<int, D>& sides, Index) {
      const T *node = in + n * kChannels, *dnode = din + n * kChannels;
      T* dv = out + n * kChannels;
      const T mass = node[D];
      for (int i = 0; i < kChannels; ++i) dv[i] = 0;
      if (mass > 0) {
        T v[D];
        for (int i = 0; i < D; ++i) {
          const T own = node[i] / mass + number[1 + i];
          v[i] = kept * own;
          dv[i] = dnumber[0] * own +
                  kept * ((dnode[i] - node[i] / mass * dnode[D]) / mass + dnumber[1 + i]);
        }
        for (int i = 0; i < D; ++i) {
          if (!sides[i]) continue;
          touch_tangent<D>(walls.contact, mu, dmu, i, T(-sides[i]), v, dv);
          touch<D>(walls.contact, mu, i, T(-sides[i]), v);
        }
      }
      dv[D] = dnode[D];
    });
  });
}

// Return mappings: from H and up to three parameters to H and what is remembered.
template <class T>
struct Elastic {
  static constexpr int kParameters = 0;
  PGJAX_INLINE static void map(Group<T>*, Group<T>*) {}
};
template <class T>
struct VonMises {
  static constexpr int kParameters = 2;
  PGJAX_INLINE static void map(Group<T>* in, Group<T>* out) { von_mises(in, out); }
};
template <class T>
struct DruckerPrager {
  static constexpr int kParameters = 3;
  PGJAX_INLINE static void map(Group<T>* in, Group<T>* out) { drucker_prager(in, out); }
};

template <class T>
struct Receiver {
  Batched<const T> xi, g, position, v, C, He, H;
  Batched<const bool> alive, finite, held;
  Batched<const T> numbers, parameters[3];
  Index parameter_step[3];
};
template <class T>
struct Received {
  Batched<T> position, v, C, He, H, history;
};

// D numbers, filled up with zeros.
template <int D, class T>
PGJAX_INLINE Vec<T> load_part(const T* x) {
  if constexpr (D == 3) return Vec<T>{x[0], x[1], x[2], 0};
  return Vec<T>{x[0], x[1], 0, 0};
}
template <int D, class T>
PGJAX_INLINE void store_part(T* x, const Vec<T>& v) {
  for (int i = 0; i < D; ++i) x[i] = v[i];
}

// The rows of a matrix of which the first D columns are given, times a number.
template <int D, class T>
struct Matrix {
  Vec<T> row[D];
};
template <int D, class T>
PGJAX_INLINE Matrix<D, T> turned_over(const Vec<T>* columns, T factor) {
  const auto row = [&](int i) {
    if constexpr (D == 3) return factor * Vec<T>{columns[0][i], columns[1][i], columns[2][i], 0};
    return factor * Vec<T>{columns[0][i], columns[1][i], 0, 0};
  };
  if constexpr (D == 3) return {row(0), row(1), row(2)};
  else return {row(0), row(1)};
}

// H <- H + dt (L + L H); from `h` to `to`.
template <int D, class T>
PGJAX_INLINE void stretch(const Matrix<D, T>& L, T dt, const T* h, T* to) {
  const Vec<T> rows[3] = {load_part<3>(h), load_part<3>(h + 3), load_part<3>(h + 6)};
#pragma GCC unroll 3
  for (int i = 0; i < D; ++i) {
    Vec<T> change = L.row[i] + L.row[i][0] * rows[0] + L.row[i][1] * rows[1];
    if constexpr (D == 3) change += L.row[i][2] * rows[2];
    store_part<3>(to + 3 * i, rows[i] + dt * change);
  }
  if constexpr (D == 2) store_part<3>(to + 6, rows[2]);
}

// The return mapping of a group of particles, in place; `in` has their parameters.
template <class Map, class T>
PGJAX_INLINE void return_map(const Receiver<T>& in, const bool* alive, Index b, Index start, int count,
                             T* He, T* history) {
  constexpr int kGiven = 9 + Map::kParameters;
  Block<T, kGiven> given;
  Block<T, 10> mapped;
  std::memset(&given, 0, sizeof given);
  const T* parameter[Map::kParameters];
  for (int k = 0; k < Map::kParameters; ++k) parameter[k] = in.parameters[k].at(b);
  for (int l = 0; l < kGroup<T>; ++l) {
    const Index p = start + std::min(l, count - 1);
    if (alive[p]) given.put(l, 0, He + 9 * p, 9);
    for (int k = 0; k < Map::kParameters; ++k)
      given.row[9 + k][l] = parameter[k][p * in.parameter_step[k]];
  }
  Map::map(given.vectors(), mapped.vectors());
  for (int l = 0; l < count; ++l) {
    const Index p = start + l;
    if (alive[p]) mapped.take(l, 0, He + 9 * p, 9);
    history[p] = alive[p] ? mapped.row[9][l] : 0;
  }
}

template <class T, int D, int K, bool Mls, class Map>
void receive(const Shape<D>& shape, Index batch, const Receiver<T>& in, const Received<T>& out,
             Pool& pool) {
  constexpr bool kPlastic = Map::kParameters > 0;
  const auto strides = shape.strides();
  for_each_member(batch, pool, [&](Index b, Pool& pool) {
    const T *xi = in.xi.at(b), *g = in.g.at(b), *numbers = in.numbers.at(b);
    const T *position = in.position.at(b), *He = in.He.at(b), *H = in.H.at(b);
    const bool *alive = in.alive.at(b), *finite = in.finite.at(b), *held = in.held.at(b);
    T *new_position = out.position.at(b), *new_v = out.v.at(b), *new_C = out.C.at(b);
    T *new_He = out.He.at(b), *new_H = out.H.at(b);
    const T dt = numbers[0], h = numbers[1], moment = numbers[2], kept = numbers[3];
    const T to_C = 1 / (moment * h), to_L = 1 / h;
    const T rest[9] = {};
    // Keeps its place and its shape; what is not finite becomes the identity.
    const auto stays = [&](Index p) {
      for (int i = 0; i < D; ++i) new_position[p * D + i] = position[p * D + i], new_v[p * D + i] = 0;
      for (int e = 0; e < D * D; ++e) new_C[p * D * D + e] = 0;
      std::memcpy(new_He + 9 * p, finite[p] ? He + 9 * p : rest, sizeof rest);
      if constexpr (kPlastic) std::memcpy(new_H + 9 * p, finite[p] ? H + 9 * p : rest, sizeof rest);
    };
    const auto moves = [&](Index p, const T* offset, Index at) {
      Axis<T, K> axes[D];
      for (int i = 0; i < D; ++i) factors<T, K>(offset[i], axes[i]);
      const auto wide = collect<T, T, K, Row<T, K>, D - 1, !Mls>(axes, g, at, strides.data());
      const auto c = narrow<Vec<T>>(last_axis(axes[D - 1]), wide);
      const Matrix<D, T> C = turned_over<D>(c.B.data(), to_C);
      const T* own_H = finite[p] ? H + 9 * p : rest;
      const T* own_He = finite[p] ? He + 9 * p : rest;
      if constexpr (Mls) {
        stretch(C, dt, own_He, new_He + 9 * p);
        if constexpr (kPlastic) stretch(C, dt, own_H, new_H + 9 * p);
      } else {
        const Matrix<D, T> L = turned_over<D>(c.S.data(), to_L);
        stretch(L, dt, own_He, new_He + 9 * p);
        if constexpr (kPlastic) stretch(L, dt, own_H, new_H + 9 * p);
      }
      const Vec<T> x = load_part<D>(position + p * D);
      if (held[p]) {
        const Vec<T> v = load_part<D>(in.v.at(b) + p * D);
        store_part<D>(new_position + p * D, x + dt * v);
        store_part<D>(new_v + p * D, v);
        for (int e = 0; e < D * D; ++e) new_C[p * D * D + e] = in.C.at(b)[p * D * D + e];
        return;
      }
      store_part<D>(new_position + p * D, x + dt * c.A);
      store_part<D>(new_v + p * D, c.A);
#pragma GCC unroll 3
      for (int i = 0; i < D; ++i) {
        const Vec<T> column = to_C * c.B[i];
        const Vec<T> spin = (C.row[i] - column) / 2, shear = (C.row[i] + column) / 2;
        store_part<D>(new_C + (p * D + i) * D, spin + kept * shear);
      }
    };
    const auto one = [&](Index p) {
      Index first[D] = {};
      T offset[D] = {};
      if (alive[p] && locate<T, D, K>(shape, xi + p * D, first, offset))
        moves(p, offset, offset_of<D>(strides, first));
      else
        stays(p);
    };
    constexpr Index kChunk = 1024, kSize = kGroup<T>;
    pool.run((shape.particles + kChunk - 1) / kChunk, [&](Index chunk) {
      const Index end = std::min(shape.particles, (chunk + 1) * kChunk);
      for (Index start = chunk * kChunk; start < end; start += kSize) {
        const int count = int(std::min(kSize, end - start));
        for (Index p = start; p < start + count; ++p) one(p);
        if constexpr (kPlastic)
          return_map<Map>(in, alive, b, start, count, new_He, out.history.at(b));
      }
    });
  });
}

}  // namespace pgjax
