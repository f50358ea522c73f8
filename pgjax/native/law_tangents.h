// Derivatives in forward mode of the laws and return mappings of `laws.h`: what they make and its
// tangent, from what they take and its tangent. See `law_pulls.h` for isotropic functions.
#pragma once

#include "law_pulls.h"

namespace pgjax {

// dB of B = F F^T - I, symmetric: 2 sym(dH F^T).
template <class V>
inline void strain_tangent(const V* h, const V* dh, V db[6]) {
  const auto entry = [&](int i, int j) {
    const V *x = h + 3 * i, *y = h + 3 * j, *dx = dh + 3 * i, *dy = dh + 3 * j;
    return dx[j] + dy[i] + (dx[0] * y[0] + dx[1] * y[1] + dx[2] * y[2]) +
           (x[0] * dy[0] + x[1] * dy[1] + x[2] * dy[2]);
  };
  db[0] = entry(0, 0), db[1] = entry(1, 1), db[2] = entry(2, 2);
  db[3] = entry(0, 1), db[4] = entry(0, 2), db[5] = entry(1, 2);
}
// dJ = cof F : dH.
template <class V>
inline V volume_tangent(const V* h, const V* dh) {
  V cofactor[9] = {}, sum = {};
  pull_volume(V{} + 1, h, cofactor);
  for (int e = 0; e < 9; ++e) sum += cofactor[e] * dh[e];
  return sum;
}

// In: H, mu, lam and their tangents. Out: the tangent of tau.
template <class V>
inline void tangent_neo_hookean(const V* in, const V* din, V* out) {
  using T = NumberOf<V>;
  const V mu = in[9], lam = in[10], dmu = din[9], dlam = din[10], zero = {};
  V b[6], db[6];
  left_strain(in, b);
  strain_tangent(in, din, db);
  const V change = volume_change(in), size = mirrored(change), J = 1 + size;
  const T at = T(kSmallestVolumeRatio);
  const auto regular = J > at;
  const V inside = regular ? size : zero;
  const V log_J = regular ? log(1 + inside, inside) : T(std::log(at)) + (J - at) / at;
  const V steep = regular ? 1 / (1 + inside) : zero + 1 / at;
  const V slope = change < -1 ? -steep : steep;
  for (int e = 0; e < 6; ++e) db[e] = dmu * b[e] + mu * db[e];
  const V pressure = dlam * log_J + lam * slope * volume_tangent(in, din);
  for (int e = 0; e < 3; ++e) db[e] += pressure;
  put_symmetric(db, out);
}

template <class V>
inline void tangent_fixed_corotated(const V* in, const V* din, V* out) {
  using T = NumberOf<V>;
  const V mu = in[9], lam = in[10], dmu = din[9], dlam = din[10], zero = {};
  V b[6], db[6], g[6], dV[6], stretch[6], values[3];
  left_strain(in, b);
  strain_tangent(in, din, db);
  const V change = volume_change(in);
  const auto p = principal_stretches(b, change);
  for (int i = 0; i < 3; ++i)
    values[i] = p.sigma[i] > 0 ? p.w[i] / (1 + at_least(p.sigma[i], zero)) : p.sigma[i] - 1;
  assemble(p.q, values, stretch);
  const V least = std::numeric_limits<T>::epsilon() * at_least(p.sigma[0], zero + T(1e-6));
  const auto divided = [&](int i, int j) {
    const V total = p.sigma[i] + p.sigma[j], size = total < 0 ? -total : total;
    return (total < 0 ? zero - 1 : zero + 1) / at_least(size, least);
  };
  into_basis(p.q, db, g);
  g[0] *= divided(0, 0), g[1] *= divided(1, 1), g[2] *= divided(2, 2);
  g[3] *= divided(0, 1), g[4] *= divided(0, 2), g[5] *= divided(1, 2);
  out_of_basis(p.q, g, dV);
  for (int e = 0; e < 6; ++e) db[e] = 2 * (dmu * (b[e] - stretch[e]) + mu * (db[e] - dV[e]));
  const V pressure = dlam * (1 + change) * change + lam * (2 * change + 1) * volume_tangent(in, din);
  for (int e = 0; e < 3; ++e) db[e] += pressure;
  put_symmetric(db, out);
}

// The tangent of the Hencky strain in the basis.
template <class V>
inline void hencky_tangent(const Stretches<V>& s, const V* h, const V* dh, V deps[6]) {
  V db[6], k[6];
  strain_tangent(h, dh, db);
  into_basis(s.q, db, deps);
  log_divided(s, k);
  for (int e = 0; e < 6; ++e) deps[e] *= k[e];
}

template <class V>
inline void tangent_stvk_hencky(const V* in, const V* din, V* out) {
  const V mu = in[9], lam = in[10], dmu = din[9], dlam = din[10];
  V b[6], e[3], g[6], s[6];
  left_strain(in, b);
  const auto p = principal_stretches(b, volume_change(in));
  log_stretches(p, e);
  hencky_tangent(p, in, din, g);
  const V pressure = dlam * (e[0] + e[1] + e[2]) + lam * (g[0] + g[1] + g[2]);
  for (int i = 0; i < 6; ++i) g[i] *= 2 * mu;
  for (int i = 0; i < 3; ++i) g[i] += 2 * dmu * e[i] + pressure;
  out_of_basis(p.q, g, s);
  put_symmetric(s, out);
}

// The tangent of H <- H + M F, M = exp(delta) - I, `ddelta` in the basis.
template <class V>
inline void flow_tangent(const Stretches<V>& s, const V delta[3], const V ddelta[6], const V* h,
                         const V* dh, V* out) {
  const V zero = {}, one = zero + 1;
  V values[3], m[6], dm[6], g[6];
  for (int i = 0; i < 3; ++i) values[i] = expm1(delta[i]);
  const auto divided = [&](int i, int j) {
    const V gap = delta[i] - delta[j];
    return (1 + values[j]) * (gap == 0 ? one : expm1(gap) / (gap == 0 ? one : gap));
  };
  for (int i = 0; i < 3; ++i) g[i] = ddelta[i] * (1 + values[i]);
  g[3] = ddelta[3] * divided(0, 1), g[4] = ddelta[4] * divided(0, 2), g[5] = ddelta[5] * divided(1, 2);
  assemble(s.q, values, m);
  out_of_basis(s.q, g, dm);
  const V rows[9] = {m[0], m[3], m[4], m[3], m[1], m[5], m[4], m[5], m[2]};
  const V drows[9] = {dm[0], dm[3], dm[4], dm[3], dm[1], dm[5], dm[4], dm[5], dm[2]};
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < 3; ++j) {
      const V *r = rows + 3 * i, *dr = drows + 3 * i;
      out[3 * i + j] = dh[3 * i + j] + (r[0] * dh[j] + r[1] * dh[3 + j] + r[2] * dh[6 + j]) + dr[j] +
                       (dr[0] * h[j] + dr[1] * h[3 + j] + dr[2] * h[6 + j]);
    }
}

// In: H, tau_Y, mu and their tangents. Out: those of H and of the increment.
template <class V>
inline void tangent_von_mises(const V* in, const V* din, V* out) {
  const V limit = in[9] / (2 * in[10]), zero = {};
  V deps[6], ddelta[6];
  const auto t = radial_return(in);
  const V* n = t.n;
  // An infinite yield stress is never reached.
  const V share = t.yields ? limit / t.safe : zero;
  const V dlimit = t.yields ? din[9] / (2 * in[10]) - limit * din[10] / in[10] : zero;
  hencky_tangent(t.s, in, din, deps);
  const V third = (deps[0] + deps[1] + deps[2]) / 3;
  for (int i = 0; i < 3; ++i) deps[i] -= third;
  const V along = n[0] * deps[0] + n[1] * deps[1] + n[2] * deps[2];
  for (int i = 0; i < 6; ++i) ddelta[i] = (share - 1) * deps[i];
  for (int i = 0; i < 3; ++i) ddelta[i] += (dlimit - share * along) * n[i];
  for (int i = 0; i < 6; ++i) ddelta[i] = t.yields ? ddelta[i] : zero;
  flow_tangent(t.s, t.delta, ddelta, in, din, out);
  for (int i = 0; i < 9; ++i) out[i] = t.yields ? out[i] : din[i];
  out[9] = t.yields ? along - dlimit : zero;
}

// In: H, slope, apex, gained and their tangents. Out: those of H and of what is gained.
template <class V>
inline void tangent_drucker_prager(const V* in, const V* din, V* out, bool correct) {
  const V slope = in[9], zero = {}, one = zero + 1;
  V deps[6], ddelta[6];
  const auto t = cone_return(in);
  const V* n = t.n;
  hencky_tangent(t.s, in, din, deps);
  const V volume = deps[0] + deps[1] + deps[2], dtrace = volume + din[11] - 3 * din[10];
  V along = zero;
  for (int i = 0; i < 3; ++i) along += n[i] * (deps[i] - volume / 3);
  // On the cone delta = gained/3 - dev eps - slope tr n; at the tip it is apex - eps.
  const V share = slope * t.trace / t.safe;
  for (int i = 0; i < 6; ++i) {
    const V shear = i < 3 ? deps[i] - volume / 3 : deps[i];
    const V normal = i < 3 ? n[i] : zero, unit = i < 3 ? one : zero;
    const V on_cone = unit * din[11] / 3 - shear - share * (shear - along * normal) -
                      (din[9] * t.trace + slope * dtrace) * normal;
    const V at_tip = unit * din[10] - deps[i];
    const V inside = correct ? unit * din[11] / 3 : zero;
    ddelta[i] = t.cone ? on_cone : (t.yields ? at_tip : (t.upright ? inside : zero));
  }
  flow_tangent(t.s, t.delta, ddelta, in, din, out);
  const V total = ddelta[0] + ddelta[1] + ddelta[2];
  out[9] = correct ? (t.yields ? din[11] - total : (t.upright ? zero : din[11])) : din[11];
}

}  // namespace pgjax
