// The derivatives of `exchange.h` in reverse mode. What a step computed is computed again.
#pragma once

#include "exchange.h"
#include "law_pulls.h"

namespace pgjax {

// Sums over all particles, in parts that do not depend on the number of threads.
template <int N>
class Sums {
 public:
  explicit Sums(Index parts) : parts_(parts * N, 0) {}
  double* part(Index k) { return parts_.data() + k * N; }
  template <class T>
  void store(T* to) const {
    double sum[N] = {};
    for (std::size_t i = 0; i < parts_.size(); ++i) sum[i % N] += parts_[i];
    for (int i = 0; i < N; ++i) to[i] = T(sum[i]);
  }
  double total(int which) const {
    double sum = 0;
    for (std::size_t i = which; i < parts_.size(); i += N) sum += parts_[i];
    return sum;
  }

 private:
  std::vector<double> parts_;
};

template <class T, template <class> class Law>
struct PullOf;
template <class T>
struct PullOf<T, NeoHookean> {
  static void run(const Group<T>* in, const Group<T>* bar, Group<T>* out) { pull_neo_hookean(in, bar, out); }
};
template <class T>
struct PullOf<T, FixedCorotated> {
  static void run(const Group<T>* in, const Group<T>* bar, Group<T>* out) {
    pull_fixed_corotated(in, bar, out);
  }
};
template <class T>
struct PullOf<T, StVKHencky> {
  static void run(const Group<T>* in, const Group<T>* bar, Group<T>* out) { pull_stvk_hencky(in, bar, out); }
};

// The cotangents of what `send` reads; those of position and H are zero.
template <class T>
struct SenderBars {
  Batched<T> xi, position, mass, volume, v, C, He, H, parameters[2], numbers;
  Index parameter_step[2];
};

// Column j of payload B or S to column j of a D x D matrix with rows of length D.
template <int D, class T>
PGJAX_INLINE void store_column(T* A, int j, const Vec<T>& column) {
  for (int i = 0; i < D; ++i) A[D * i + j] = column[i];
}

template <class T, int D, int K, bool Mls, template <class> class Law>
void send_pull(const Shape<D>& shape, Index batch, const Sender<T>& in, Batched<const T> g_bar,
               const SenderBars<T>& out, Pool& pool) {
  constexpr Index kChunk = 1024, kSize = kGroup<T>;
  const auto strides = shape.strides();
  const Index P = shape.particles, chunks = (P + kChunk - 1) / kChunk;
  for_each_member(batch, pool, [&](Index b, Pool& pool) {
    const T *xi = in.xi.at(b), *position = in.position.at(b), *v = in.v.at(b), *C = in.C.at(b);
    const T *He = in.He.at(b), *H = in.H.at(b), *mass = in.mass.at(b), *volume = in.volume.at(b);
    const bool *alive = in.alive.at(b), *inside = in.inside.at(b);
    const T* g = g_bar.at(b);
    const T dt = in.numbers.at(b)[0], h = in.numbers.at(b)[1], D_p = in.numbers.at(b)[2];
    const T factor = Mls ? -dt / D_p * h : -dt / h;
    const Parameter<T> mu{in.parameters[0].at(b), in.parameter_step[0]};
    const Parameter<T> lam{in.parameters[1].at(b), in.parameter_step[1]};
    clear(out.position.at(b), P * D * sizeof(T), pool);
    if (in.has_H) clear(out.H.at(b), P * 9 * sizeof(T), pool);
    // Of h through mass h C, of factor, of mu and of lam.
    Sums<4> sums(chunks);
    const auto pull_group = [&](Index start, int count, double* partial) {
      Block<T, 11> given, pulled;
      Block<T, 11> made;
      Block<T, 9> bar;
      bool goes_on[kSize] = {};
      std::memset(&given, 0, sizeof given), std::memset(&bar, 0, sizeof bar);
      for (int l = 0; l < count; ++l) {
        const Index p = start + l;
        T zero = zero_if_finite<9>(He + 9 * p) + zero_if_finite<D>(position + D * p);
        zero += zero_if_finite<D * D>(C + D * D * p) + zero_if_finite<D>(v + D * p);
        if (in.has_H) zero += zero_if_finite<9>(H + 9 * p);
        goes_on[l] = zero == 0 && alive[p] && inside[p];
        if (goes_on[l]) given.put(l, 0, He + 9 * p, 9);
        given.row[9][l] = mu.at(p), given.row[10][l] = lam.at(p);
      }
      Law<T>::stress(given.vectors(), made.vectors());
      for (int l = 0; l < count; ++l) {
        const Index p = start + l;
        T tau[9];
        made.take(l, 0, tau, 9);
        Index first[D] = {};
        T offset[D] = {};
        goes_on[l] = goes_on[l] && zero_if_finite<9>(tau) == 0 &&
                     locate<T, D, K>(shape, xi + p * D, first, offset);
        T *to_xi = out.xi.at(b) + p * D, *to_v = out.v.at(b) + p * D, *to_C = out.C.at(b) + p * D * D;
        if (!goes_on[l]) {
          for (int i = 0; i < D; ++i) to_xi[i] = 0, to_v[i] = 0;
          for (int e = 0; e < D * D; ++e) to_C[e] = 0;
          out.mass.at(b)[p] = 0, out.volume.at(b)[p] = 0;
          continue;
        }
        Axis<T, K> axes[D], slopes[D];
        for (int i = 0; i < D; ++i) factors<T, K>(offset[i], axes[i], slopes[i]);
        const T m = mass[p], f = factor * volume[p];
        const auto c = momentum_and_force<T, D, Mls>(m, h, f, v + D * p, C + D * D * p, tau);
        const auto last = last_axis(axes[D - 1]);
        Row<T, K> along[D - 1] = {};
        const auto wide = differentiate<T, K>(axes, slopes, widen(last, c), g,
                                              offset_of<D>(strides, first), strides.data(), along);
        for (int i = 0; i < D - 1; ++i) to_xi[i] = total(sum(along[i]));
        to_xi[D - 1] = total(sum(product(widen(last_axis(slopes[D - 1]), c), wide)));
        const auto back = narrow<Vec<T>>(last, wide);
        T of_mass = back.A[D], through_h = 0, through_factor = 0;
        for (int i = 0; i < D; ++i) to_v[i] = m * back.A[i], of_mass += back.A[i] * v[D * p + i];
#pragma GCC unroll 3
        for (int j = 0; j < D; ++j) {
          store_column<D>(to_C, j, m * h * back.B[j]);
          const Vec<T> flux = [&] {
            if constexpr (Mls)
              return back.B[j];
            else
              return back.S[j];
          }();
          for (int i = 0; i < D; ++i) {
            through_h += back.B[j][i] * C[D * D * p + D * i + j];
            through_factor += flux[i] * tau[3 * i + j];
            bar.row[3 * i + j][l] = f * flux[i];
          }
        }
        out.mass.at(b)[p] = of_mass + h * through_h;
        out.volume.at(b)[p] = factor * through_factor;
        partial[0] += double(m) * through_h, partial[1] += double(volume[p]) * through_factor;
      }
      PullOf<T, Law>::run(given.vectors(), bar.vectors(), pulled.vectors());
      for (int l = 0; l < count; ++l) {
        const Index p = start + l;
        T* to_He = out.He.at(b) + 9 * p;
        for (int e = 0; e < 9; ++e) to_He[e] = goes_on[l] ? pulled.row[e][l] : 0;
        for (int k = 0; k < 2; ++k) {
          const T value = goes_on[l] ? pulled.row[9 + k][l] : 0;
          if (out.parameter_step[k]) out.parameters[k].at(b)[p] = value;
          partial[2 + k] += value;
        }
      }
    };
    pool.run(chunks, [&](Index chunk) {
      const Index end = std::min(P, (chunk + 1) * kChunk);
      for (Index p = chunk * kChunk; p < end; p += kSize)
        pull_group(p, int(std::min(kSize, end - p)), sums.part(chunk));
    });
    T* number = out.numbers.at(b);
    const double of_h = sums.total(0), of_factor = sums.total(1);
    // factor = -dt h/D or -dt/h.
    number[0] = T(of_factor * (Mls ? -double(h) / D_p : -1 / double(h)));
    number[1] = T(of_h + of_factor * (Mls ? -double(dt) / D_p : double(dt) / (double(h) * h)));
    number[2] = T(Mls ? of_factor * double(dt) * h / (double(D_p) * D_p) : 0);
    for (int k = 0; k < 2; ++k)
      if (!out.parameter_step[k]) out.parameters[k].at(b)[0] = T(sums.total(2 + k));
  });
}

// The derivative of `touch` at v in reverse mode, in place; returns that of the friction.
template <int D, class T>
PGJAX_INLINE T touch_pull(Contact contact, T friction, int axis, T inward, const T v[D], T bar[D]) {
  const T normal_speed = inward * v[axis];
  if (contact == kSticky)
    for (int i = 0; i < D; ++i) bar[i] = 0;
  if (contact == kSlip) bar[axis] = 0;
  if (contact != kSeparating || !(normal_speed < 0)) return 0;
  T square = 0, along = 0;
  for (int i = 0; i < D; ++i)
    if (i != axis) square += v[i] * v[i], along += v[i] * bar[i];
  bar[axis] = 0;
  if (!(square > 0)) return 0;
  const T speed = std::sqrt(square), left = 1 + friction * normal_speed / speed;
  for (int i = 0; i < D; ++i)
    if (i != axis)
      bar[i] = left > 0 ? left * bar[i] - along * friction * normal_speed / (speed * square) * v[i] : 0;
  bar[axis] = left > 0 ? along * friction / speed * inward : 0;
  return left > 0 ? along * normal_speed / speed : 0;
}

// From the cotangents of velocity and mass of a node to those of momentum and mass.
template <class T, int D>
void velocities_pull(const Index nodes[D], Index batch, const Walls<D>& walls, Batched<const T> from,
                     Batched<const T> numbers, Batched<const T> friction, Batched<const T> bar,
                     Batched<T> to, Batched<T> numbers_bar, Batched<T> friction_bar, Pool& pool) {
  for_each_member(batch, pool, [&](Index b, Pool& pool) {
    const T *in = from.at(b), *number = numbers.at(b), *above = bar.at(b);
    const T kept = number[0], mu = *friction.at(b);
    T* out = to.at(b);
    Sums<2 + D> sums(node_chunks<D>(nodes));
    for_each_node<D>(nodes, walls, b, pool, [&](Index n, const std::array<int, D>& sides, Index chunk) {
      const T *node = in + n * kChannels, *given = above + n * kChannels;
      T* back = out + n * kChannels;
      const T mass = node[D];
      for (int i = 0; i < kChannels; ++i) back[i] = 0;
      back[D] = given[D];
      if (!(mass > 0)) return;
      T v[D + 1][D], v_bar[D];
      for (int i = 0; i < D; ++i) v[0][i] = kept * (node[i] / mass + number[1 + i]), v_bar[i] = given[i];
      double* partial = sums.part(chunk);
      for (int k = 0; k < D; ++k) {
        for (int i = 0; i < D; ++i) v[k + 1][i] = v[k][i];
        if (sides[k]) touch<D>(walls.contact, mu, k, T(-sides[k]), v[k + 1]);
      }
      for (int k = D - 1; k >= 0; --k)
        if (sides[k]) partial[1 + D] += touch_pull<D>(walls.contact, mu, k, T(-sides[k]), v[k], v_bar);
      T along = 0, through_kept = 0;
      for (int i = 0; i < D; ++i) {
        back[i] = v_bar[i] * kept / mass;
        along += back[i] * node[i];
        through_kept += v_bar[i] * (node[i] / mass + number[1 + i]);
        partial[1 + i] += double(v_bar[i]) * kept;
      }
      back[D] -= along / mass;
      partial[0] += through_kept;
    });
    T total[2 + D];
    sums.store(total);
    for (int i = 0; i <= D; ++i) numbers_bar.at(b)[i] = total[i];
    *friction_bar.at(b) = total[1 + D];
  });
}

// The cotangents of what `receive` makes, and of what it reads.
template <class T>
struct ReceivedBars {
  Batched<const T> position, v, C, He, H, history;
};
template <class T>
struct ReceiverBars {
  Batched<T> xi, g, position, v, C, He, H, parameters[3], numbers;
  Index parameter_step[3];
};

template <class T, class Map>
PGJAX_INLINE void pull_map(const Group<T>* in, const Group<T>* bar, Group<T>* out, bool correct) {
  if constexpr (Map::kParameters == 2)
    pull_von_mises(in, bar, out);
  else
    pull_drucker_prager(in, bar, out, correct);
}

template <class T, int D, int K, bool Mls, class Map>
void receive_pull(const Shape<D>& shape, Index batch, const Receiver<T>& in, bool correct,
                  const ReceivedBars<T>& bar, const ReceiverBars<T>& out, Pool& pool) {
  constexpr Index kSize = kGroup<T>;
  constexpr bool kPlastic = Map::kParameters > 0;
  const auto strides = shape.strides();
  for_each_member(batch, pool, [&](Index b, Pool& pool) {
    const T *xi = in.xi.at(b), *g = in.g.at(b), *numbers = in.numbers.at(b);
    const T *He = in.He.at(b), *H = in.H.at(b);
    const bool *alive = in.alive.at(b), *finite = in.finite.at(b), *held = in.held.at(b);
    const T dt = numbers[0], h = numbers[1], moment = numbers[2], kept = numbers[3];
    const T to_C = 1 / (moment * h), to_L = 1 / h;
    clear(out.g.at(b), shape.node_count() * kChannels * sizeof(T), pool);
    const Columns<T, D, K> columns(shape, xi);
    // Of dt, of C, of L, of what is kept, and of parameters.
    constexpr int kSums = 7;
    Sums<kSums> sums(columns.groups(kSize));
    const auto pull_group = [&](const std::int32_t* order, int count, Index group) {
      double* partial = sums.part(group);
      // The cotangents of the trial state.
      T trial_bar[kSize][9] = {};
      if constexpr (kPlastic) {
        Block<T, 9 + Map::kParameters> given, pulled;
        Block<T, 10> made;
        std::memset(&given, 0, sizeof given), std::memset(&made, 0, sizeof made);
        for (int l = 0; l < kSize; ++l) {
          const Index p = order[std::min(l, count - 1)];
          for (int k = 0; k < Map::kParameters; ++k)
            given.row[9 + k][l] = in.parameters[k].at(b)[p * in.parameter_step[k]];
          if (l >= count || !alive[p]) continue;
          Index first[D] = {};
          T offset[D] = {}, trial[9];
          locate<T, D, K>(shape, xi + p * D, first, offset);
          Axis<T, K> axes[D];
          for (int i = 0; i < D; ++i) factors<T, K>(offset[i], axes[i]);
          const auto wide = collect<T, T, K, Row<T, K>, D - 1, !Mls>(
              axes, g, offset_of<D>(strides, first), strides.data());
          const auto c = narrow<Vec<T>>(last_axis(axes[D - 1]), wide);
          const T rest[9] = {};
          if constexpr (Mls)
            stretch(turned_over<D>(c.B.data(), to_C), dt, finite[p] ? He + 9 * p : rest, trial);
          else
            stretch(turned_over<D>(c.S.data(), to_L), dt, finite[p] ? He + 9 * p : rest, trial);
          given.put(l, 0, trial, 9);
          made.put(l, 0, bar.He.at(b) + 9 * p, 9);
          made.row[9][l] = bar.history.at(b)[p];
        }
        pull_map<T, Map>(given.vectors(), made.vectors(), pulled.vectors(), correct);
        for (int l = 0; l < count; ++l) {
          const Index p = order[l];
          if (alive[p])
            pulled.take(l, 0, trial_bar[l], 9);
          else
            std::memcpy(trial_bar[l], bar.He.at(b) + 9 * p, sizeof trial_bar[l]);
          for (int k = 0; k < Map::kParameters; ++k) {
            const T value = alive[p] ? pulled.row[9 + k][l] : 0;
            if (out.parameter_step[k]) out.parameters[k].at(b)[p] = value;
            partial[4 + k] += value;
          }
        }
      } else {
        for (int l = 0; l < count; ++l)
          std::memcpy(trial_bar[l], bar.He.at(b) + 9 * order[l], sizeof trial_bar[l]);
      }
      for (int l = 0; l < count; ++l) {
        const Index p = order[l];
        T *to_He = out.He.at(b) + 9 * p, *to_H = out.H.at(b) + 9 * p, *to_C_bar = out.C.at(b) + D * D * p;
        T *to_x = out.position.at(b) + D * p, *to_v = out.v.at(b) + D * p, *to_xi = out.xi.at(b) + D * p;
        const T *x_bar = bar.position.at(b) + D * p, *C_bar = bar.C.at(b) + D * D * p;
        for (int i = 0; i < D; ++i) to_x[i] = x_bar[i], to_v[i] = 0, to_xi[i] = 0;
        for (int e = 0; e < D * D; ++e) to_C_bar[e] = 0;
        const T rest[9] = {};
        const T *own_He = finite[p] ? He + 9 * p : rest, *own_H = finite[p] ? H + 9 * p : rest;
        const T* H_bar = kPlastic ? bar.H.at(b) + 9 * p : rest;
        Index first[D] = {};
        T offset[D] = {};
        if (!alive[p] || !locate<T, D, K>(shape, xi + p * D, first, offset)) {
          for (int e = 0; e < 9; ++e) to_He[e] = finite[p] ? trial_bar[l][e] : 0;
          if constexpr (kPlastic)
            for (int e = 0; e < 9; ++e) to_H[e] = finite[p] ? H_bar[e] : 0;
          continue;
        }
        // Of L: dt bar (I + H)^T.
        T L_bar[D][D];
        for (int i = 0; i < D; ++i)
          for (int j = 0; j < D; ++j) {
            T s = 0;
            for (int k = 0; k < 3; ++k) {
              s += trial_bar[l][3 * i + k] * (own_He[3 * j + k] + (j == k));
              if constexpr (kPlastic) s += H_bar[3 * i + k] * (own_H[3 * j + k] + (j == k));
            }
            L_bar[i][j] = dt * s;
          }
        Vec<T> v_bar = {};
        T G[D][D];  // of C as it was gathered
        for (int i = 0; i < D; ++i) {
          v_bar[i] = bar.v.at(b)[D * p + i] + dt * x_bar[i];
          for (int j = 0; j < D; ++j) {
            const T x = C_bar[D * i + j], y = C_bar[D * j + i];
            G[i][j] = (x - y) / 2 + kept * (x + y) / 2;
          }
        }
        if (held[p]) {
          for (int i = 0; i < D; ++i) {
            to_v[i] = v_bar[i], partial[0] += x_bar[i] * in.v.at(b)[D * p + i];
            for (int j = 0; j < D; ++j) to_C_bar[D * i + j] = C_bar[D * i + j], G[i][j] = 0;
          }
          v_bar = Vec<T>{};
        }
        Coefficients<Vec<T>, D, !Mls> payload;
        payload.A = v_bar;
        for (int j = 0; j < D; ++j) {
          Vec<T> column = {}, of_L = {};
          for (int i = 0; i < D; ++i) {
            if constexpr (Mls)
              column[i] = (G[i][j] + L_bar[i][j]) * to_C;
            else
              column[i] = G[i][j] * to_C, of_L[i] = L_bar[i][j] * to_L;
          }
          payload.B[j] = column;
          if constexpr (!Mls) payload.S[j] = of_L;
        }
        Axis<T, K> axes[D], slopes[D];
        for (int i = 0; i < D; ++i) factors<T, K>(offset[i], axes[i], slopes[i]);
        const Index at = offset_of<D>(strides, first);
        const auto last = last_axis(axes[D - 1]);
        const auto spread_out = widen(last, payload);
        Row<T, K> along[D - 1] = {};
        const auto wide = differentiate<T, K>(axes, slopes, spread_out, g, at, strides.data(), along);
        for (int i = 0; i < D - 1; ++i) to_xi[i] = total(sum(along[i]));
        to_xi[D - 1] = total(sum(product(widen(last_axis(slopes[D - 1]), payload), wide)));
        spread<T>(axes, spread_out, out.g.at(b) + at, strides.data());
        // What was gathered.
        const auto c = narrow<Vec<T>>(last, wide);
        T L[D][D];
        T through_C = 0, through_L = 0, through_kept = 0, through_dt = 0;
        for (int i = 0; i < D; ++i) {
          if (!held[p]) through_dt += x_bar[i] * c.A[i];
          for (int j = 0; j < D; ++j) {
            const T C_ij = c.B[j][i] * to_C, C_ji = c.B[i][j] * to_C;
            if constexpr (Mls)
              L[i][j] = C_ij, through_C += L_bar[i][j] * C_ij;
            else
              L[i][j] = c.S[j][i] * to_L, through_L += L_bar[i][j] * L[i][j];
            through_C += G[i][j] * C_ij;
            if (!held[p]) through_kept += C_bar[D * i + j] * (C_ij + C_ji) / 2;
          }
        }
        // bar + dt L^T bar, and bar : (L + L H) for dt.
        const auto pull_stretch = [&](const T* above, const T* h_own, T* to) {
          for (int i = 0; i < 3; ++i)
            for (int k = 0; k < 3; ++k) {
              T s = 0;
              if (i < D)
                for (int j = 0; j < D; ++j) s += L[j][i] * above[3 * j + k];
              to[3 * i + k] = finite[p] ? above[3 * i + k] + dt * s : 0;
              through_dt += s * (h_own[3 * i + k] + (i == k));
            }
        };
        pull_stretch(trial_bar[l], own_He, to_He);
        if constexpr (kPlastic) pull_stretch(H_bar, own_H, to_H);
        partial[0] += through_dt, partial[1] += through_C, partial[2] += through_L, partial[3] += through_kept;
      }
    };
    columns.for_each_numbered_group(pool, kSize, pull_group);
    T* number = out.numbers.at(b);
    number[0] = T(sums.total(0));
    number[1] = T(-(sums.total(1) + sums.total(2)) / h);
    number[2] = T(-sums.total(1) / moment);
    number[3] = T(sums.total(3));
    if constexpr (kPlastic)
      for (int k = 0; k < Map::kParameters; ++k)
        if (!out.parameter_step[k]) out.parameters[k].at(b)[0] = T(sums.total(4 + k));
  });
}

}  // namespace pgjax
