// The derivatives of `exchange.h` in forward mode.
#pragma once

#include "exchange.h"
#include "law_tangents.h"

namespace pgjax {

template <class T>
PGJAX_INLINE void law_tangent(NeoHookean<T>, const Group<T>* in, const Group<T>* din, Group<T>* out) {
  tangent_neo_hookean(in, din, out);
}
template <class T>
PGJAX_INLINE void law_tangent(FixedCorotated<T>, const Group<T>* in, const Group<T>* din, Group<T>* out) {
  tangent_fixed_corotated(in, din, out);
}
template <class T>
PGJAX_INLINE void law_tangent(StVKHencky<T>, const Group<T>* in, const Group<T>* din, Group<T>* out) {
  tangent_stvk_hencky(in, din, out);
}

// The tangent of `momentum_and_force`: tangents of its arguments, and of mass h for mass and h.
template <class T, int D, bool Mls>
PGJAX_INLINE Coefficients<Vec<T>, D, !Mls> momentum_and_force_tangent(
    T mass, T h, T factor, const T* v, const T* C, const T* tau, T dmass, T dh, T dfactor, const T* dv,
    const T* dC, const T* dtau) {
  const auto column = [](const T* A, int row, int j) {
    if constexpr (D == 3) return Vec<T>{A[j], A[row + j], A[2 * row + j], 0};
    return Vec<T>{A[j], A[row + j], 0, 0};
  };
  Coefficients<Vec<T>, D, !Mls> c;
  c.A = dmass * load_part<D>(v) + mass * load_part<D>(dv);
  c.A[D] = dmass;
#pragma GCC unroll 3
  for (int j = 0; j < D; ++j) {
    const Vec<T> flux = dfactor * column(tau, 3, j) + factor * column(dtau, 3, j);
    c.B[j] = (dmass * h + mass * dh) * column(C, D, j) + mass * h * column(dC, D, j);
    if constexpr (Mls)
      c.B[j] += flux;
    else
      c.S[j] = flux;
  }
  return c;
}

// `along` has the tangents of what `in` has.
template <class T, int D, int K, bool Mls, class Law>
void send_tangent(const Shape<D>& shape, Index batch, const Sender<T>& in, const Sender<T>& along,
                  Batched<T> dg, Pool& pool) {
  constexpr int kSize = kGroup<T>;
  const auto strides = shape.strides();
  for_each_member(batch, pool, [&](Index b, Pool& pool) {
    const T *xi = in.xi.at(b), *position = in.position.at(b), *v = in.v.at(b), *C = in.C.at(b);
    const T *He = in.He.at(b), *H = in.H.at(b), *mass = in.mass.at(b), *volume = in.volume.at(b);
    const T *dxi = along.xi.at(b), *dv = along.v.at(b), *dC = along.C.at(b), *dHe = along.He.at(b);
    const T *dmass = along.mass.at(b), *dvolume = along.volume.at(b);
    const bool *alive = in.alive.at(b), *inside = in.inside.at(b);
    T* const nodes = dg.at(b);
    clear(nodes, shape.node_count() * kChannels * sizeof(T), pool);
    const T *numbers = in.numbers.at(b), *dnumbers = along.numbers.at(b);
    const T dt = numbers[0], h = numbers[1], D_p = numbers[2], dh = dnumbers[1];
    const T factor = Mls ? -dt / D_p * h : -dt / h;
    const T dfactor = Mls ? -(dnumbers[0] * h + dt * dh - dt * h / D_p * dnumbers[2]) / D_p
                          : -(dnumbers[0] - dt / h * dh) / h;
    const Parameter<T> mu{in.parameters[0].at(b), in.parameter_step[0]};
    const Parameter<T> lam{in.parameters[1].at(b), in.parameter_step[1]};
    const Parameter<T> dmu{along.parameters[0].at(b), in.parameter_step[0]};
    const Parameter<T> dlam{along.parameters[1].at(b), in.parameter_step[1]};
    const auto send_group = [&](const std::int32_t* order, int count) {
      Block<T, 11> given, moved, made;
      Block<T, 9> change;
      bool sound[kSize] = {};
      std::memset(&given, 0, sizeof given), std::memset(&moved, 0, sizeof moved);
      for (int l = 0; l < count; ++l) {
        const Index p = order[l];
        T zero = zero_if_finite<9>(He + 9 * p) + zero_if_finite<D>(position + D * p);
        zero += zero_if_finite<D * D>(C + D * D * p) + zero_if_finite<D>(v + D * p);
        if (in.has_H) zero += zero_if_finite<9>(H + 9 * p);
        sound[l] = zero == 0 && alive[p] && inside[p];
        if (sound[l]) given.put(l, 0, He + 9 * p, 9), moved.put(l, 0, dHe + 9 * p, 9);
        given.row[9][l] = mu.at(p), given.row[10][l] = lam.at(p);
        moved.row[9][l] = dmu.at(p), moved.row[10][l] = dlam.at(p);
      }
      Law::stress(given.vectors(), made.vectors());
      law_tangent(Law(), given.vectors(), moved.vectors(), change.vectors());
      for (int l = 0; l < count; ++l) {
        const Index p = order[l];
        T tau[9], dtau[9];
        made.take(l, 0, tau, 9), change.take(l, 0, dtau, 9);
        Index first[D] = {};
        T offset[D] = {};
        if (!sound[l] || zero_if_finite<9>(tau) != 0) continue;
        if (!locate<T, D, K>(shape, xi + p * D, first, offset)) continue;
        Axis<Dual<T>, K> axes[D];
        for (int i = 0; i < D; ++i) axes[i] = moving_factors<T, K>(offset[i], dxi[D * p + i]);
        const T f = factor * volume[p], df = dfactor * volume[p] + factor * dvolume[p];
        const auto c = momentum_and_force<T, D, Mls>(mass[p], h, f, v + D * p, C + D * D * p, tau);
        const auto dc = momentum_and_force_tangent<T, D, Mls>(
            mass[p], h, f, v + D * p, C + D * D * p, tau, dmass[p], dh, df, dv + D * p,
            dC + D * D * p, dtau);
        spread<T>(axes, widen(last_axis(axes[D - 1]), paired(c, dc)),
                  nodes + offset_of<D>(strides, first), strides.data());
      }
    };
    Columns<T, D, K>(shape, xi).for_each_group(pool, kSize, send_group);
  });
}

template <class T>
PGJAX_INLINE void map_tangent(VonMises<T>, const Group<T>* in, const Group<T>* din, Group<T>* out, bool) {
  tangent_von_mises(in, din, out);
}
template <class T>
PGJAX_INLINE void map_tangent(DruckerPrager<T>, const Group<T>* in, const Group<T>* din, Group<T>* out,
                              bool correct) {
  tangent_drucker_prager(in, din, out, correct);
}

template <class T, int D, int K, bool Mls, class Map>
void receive_tangent(const Shape<D>& shape, Index batch, const Receiver<T>& in,
                     const Receiver<T>& along, bool correct, const Received<T>& out, Pool& pool) {
  constexpr bool kPlastic = Map::kParameters > 0;
  constexpr Index kChunk = 1024, kSize = kGroup<T>;
  const auto strides = shape.strides();
  for_each_member(batch, pool, [&](Index b, Pool& pool) {
    const T *xi = in.xi.at(b), *dxi = along.xi.at(b), *He = in.He.at(b), *H = in.H.at(b);
    const T *dHe = along.He.at(b), *dH = along.H.at(b);
    const bool *alive = in.alive.at(b), *finite = in.finite.at(b), *held = in.held.at(b);
    const T *numbers = in.numbers.at(b), *dnumbers = along.numbers.at(b);
    const T dt = numbers[0], h = numbers[1], moment = numbers[2], kept = numbers[3];
    const T ddt = dnumbers[0], dkept = dnumbers[3];
    const T to_C = 1 / (moment * h), to_L = 1 / h, dto_L = -to_L / h * dnumbers[1];
    const T dto_C = -to_C * (dnumbers[1] / h + dnumbers[2] / moment);
    const Dual<const T*> both{in.g.at(b), along.g.at(b)};
    // The trial state of one particle and its tangent.
    const auto one = [&](Index p, T* trial, T* dtrial) {
      const T rest[9] = {};
      T L[3][3] = {}, dL[3][3] = {}, v[D] = {}, dv[D] = {}, C[D][D] = {}, dC[D][D] = {};
      Index first[D] = {};
      T offset[D] = {};
      const bool moves = alive[p] && locate<T, D, K>(shape, xi + p * D, first, offset);
      if (moves) {
        Axis<Dual<T>, K> axes[D];
        for (int i = 0; i < D; ++i) axes[i] = moving_factors<T, K>(offset[i], dxi[D * p + i]);
        const auto wide = collect<T, Dual<T>, K, Dual<Row<T, K>>, D - 1, !Mls>(
            axes, both, offset_of<D>(strides, first), strides.data());
        const auto c = narrow<Dual<Vec<T>>>(last_axis(axes[D - 1]), wide);
        for (int i = 0; i < D; ++i) {
          v[i] = c.A.v[i], dv[i] = c.A.d[i];
          for (int j = 0; j < D; ++j) {
            C[i][j] = c.B[j].v[i] * to_C;
            dC[i][j] = c.B[j].d[i] * to_C + c.B[j].v[i] * dto_C;
            if constexpr (Mls)
              L[i][j] = C[i][j], dL[i][j] = dC[i][j];
            else
              L[i][j] = c.S[j].v[i] * to_L, dL[i][j] = c.S[j].d[i] * to_L + c.S[j].v[i] * dto_L;
          }
        }
        if (held[p])
          for (int i = 0; i < D; ++i)
            v[i] = in.v.at(b)[D * p + i], dv[i] = along.v.at(b)[D * p + i];
      }
      for (int i = 0; i < D; ++i) {
        const T own = along.position.at(b)[D * p + i];
        out.position.at(b)[D * p + i] = moves ? own + ddt * v[i] + dt * dv[i] : own;
        out.v.at(b)[D * p + i] = dv[i];
        for (int j = 0; j < D; ++j) {
          const T spin = (dC[i][j] - dC[j][i]) / 2;
          const T shear = kept * (dC[i][j] + dC[j][i]) / 2 + dkept * (C[i][j] + C[j][i]) / 2;
          const bool kept_own = moves && held[p];
          out.C.at(b)[(D * p + i) * D + j] =
              kept_own ? along.C.at(b)[(D * p + i) * D + j] : spin + shear;
        }
      }
      const auto stretched = [&](const T* own, const T* down, T* to, T* dto) {
        for (int i = 0; i < 3; ++i)
          for (int k = 0; k < 3; ++k) {
            T change = L[i][k], dchange = dL[i][k];
            for (int j = 0; j < D; ++j) {
              change += L[i][j] * own[3 * j + k];
              dchange += dL[i][j] * own[3 * j + k] + L[i][j] * down[3 * j + k];
            }
            to[3 * i + k] = own[3 * i + k] + dt * change;
            dto[3 * i + k] = down[3 * i + k] + ddt * change + dt * dchange;
          }
      };
      stretched(finite[p] ? He + 9 * p : rest, finite[p] ? dHe + 9 * p : rest, trial, dtrial);
      if constexpr (kPlastic) {
        T unused[9];
        stretched(finite[p] ? H + 9 * p : rest, finite[p] ? dH + 9 * p : rest, unused,
                  out.H.at(b) + 9 * p);
      }
    };
    const auto one_group = [&](Index start, int count) {
      Block<T, 9 + Map::kParameters> given, moved;
      Block<T, 10> made;
      std::memset(&given, 0, sizeof given), std::memset(&moved, 0, sizeof moved);
      T dtrial[kSize][9];
      for (int l = 0; l < count; ++l) {
        T trial[9];
        one(start + l, trial, dtrial[l]);
        if (kPlastic && alive[start + l]) given.put(l, 0, trial, 9), moved.put(l, 0, dtrial[l], 9);
      }
      if constexpr (kPlastic) {
        for (int k = 0; k < Map::kParameters; ++k)
          for (int l = 0; l < kSize; ++l) {
            const Index at = (start + std::min(l, count - 1)) * in.parameter_step[k];
            given.row[9 + k][l] = in.parameters[k].at(b)[at];
            moved.row[9 + k][l] = along.parameters[k].at(b)[at];
          }
        map_tangent(Map(), given.vectors(), moved.vectors(), made.vectors(), correct);
      }
      for (int l = 0; l < count; ++l) {
        const Index p = start + l;
        T* to = out.He.at(b) + 9 * p;
        if (kPlastic && alive[p])
          made.take(l, 0, to, 9);
        else
          std::memcpy(to, dtrial[l], sizeof dtrial[l]);
        if constexpr (kPlastic) out.history.at(b)[p] = alive[p] ? made.row[9][l] : 0;
      }
    };
    pool.run((shape.particles + kChunk - 1) / kChunk, [&](Index chunk) {
      const Index end = std::min(shape.particles, (chunk + 1) * kChunk);
      for (Index p = chunk * kChunk; p < end; p += kSize) one_group(p, int(std::min(kSize, end - p)));
    });
  });
}

}  // namespace pgjax
