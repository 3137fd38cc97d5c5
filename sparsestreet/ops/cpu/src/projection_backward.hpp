// From the sums over pixels back to the parameters, a register of visible rows at a time: slots of a row are summed in
// a fixed order.
#pragma once
#include <omp.h>

#include "prepare.hpp"

namespace SPLAT_VARIANT {

// Gradients of one splat on the screen, in natural units (exponent -|L d|^2 / 2).
template <class V>
struct ScreenGradient {
  V x, y, abs_x, abs_y, l11, l21, l22;
  V log_opacity;
  Vector<V> color;
  V depth;
};

// ln alpha = ln o - ln 2 |L d|^2 with the record's L, which is the Cholesky factor times k = LOG2_SCALE.
template <class V>
inline ScreenGradient<V> screen_gradient(const Slot<V>& sum, const Splat<V>& s) {
  using T = Scalar<V>;
  const T two_ln2 = T(TWO_LN2);
  ScreenGradient<V> g;
  g.x = two_ln2 * s.l11 * sum.sa;
  g.y = two_ln2 * (s.l21 * sum.sa + s.l22 * sum.sb);
  g.abs_x = two_ln2 * s.l11 * sum.abs_x, g.abs_y = two_ln2 * sum.abs_y;
  g.l11 = -two_ln2 * T(LOG2_SCALE) * sum.sa_dx;
  g.l21 = -two_ln2 * T(LOG2_SCALE) * sum.sa_dy;
  g.l22 = -two_ln2 * T(LOG2_SCALE) * sum.sb_dy;
  g.log_opacity = sum.s;
  g.color = {sum.color[0], sum.color[1], sum.color[2]};
  g.depth = sum.depth;
  return g;
}

// Through l11 = sqrt(C_yy / det), l21 = -C_xy / sqrt(C_yy det), l22 = 1 / sqrt(C_yy) and the antialias compensation
// sqrt(bare / det) to the footprint, with det = bare + eps2d |F|^2 + eps2d^2 and bare the sum of squared minors.
template <class T, class V, int K>
inline Footprint<V, K> footprint_backward(const Camera<T>& camera, const Footprint<V, K>& f,
                                          const ScreenGradient<V>& g) {
  const Covariance<V, K> c(camera, f);
  const V deviations = root(c.yy) * root(c.determinant);
  const V l11 = root(c.yy / c.determinant), l21 = -c.xy / deviations, l22 = 1 / root(c.yy);
  const V v_yy = (g.l11 * l11 - g.l21 * l21 - g.l22 * l22) / (2 * c.yy), v_xy = -g.l21 / deviations;
  V v_bare = -(g.l11 * l11 + g.l21 * l21) / (2 * c.determinant);
  V v_square = v_bare * camera.eps2d;  // of |F|^2
  if (camera.antialias) {
    // d ratio = ((1 - ratio) d bare - ratio eps2d d|F|^2) / det, and the logarithm of the opacity holds ln(ratio) / 2.
    const V ratio = c.bare_determinant / c.determinant;
    const V v_ratio = ratio > T(COMPENSATION_FLOOR) ? g.log_opacity / (2 * ratio) : V{};
    v_bare += v_ratio * (1 - ratio) / c.determinant;
    v_square -= v_ratio * ratio * camera.eps2d / c.determinant;
  }
  Footprint<V, K> out;
  out.x = g.x, out.y = g.y;
  for (int i = 0; i < K; ++i) {
    V along_x{}, along_y{};
    for (int j = 0; j < K; ++j) {
      const V minor = f.factor_x[i] * f.factor_y[j] - f.factor_x[j] * f.factor_y[i];
      along_x += minor * f.factor_y[j], along_y -= minor * f.factor_x[j];
    }
    out.factor_x[i] = 2 * (v_bare * along_x + v_square * f.factor_x[i]) + v_xy * f.factor_y[i];
    out.factor_y[i] = 2 * (v_bare * along_y + (v_square + v_yy) * f.factor_y[i]) + v_xy * f.factor_x[i];
  }
  return out;
}

// Fills the gradient of the coefficients; answers that of the mean in the camera through the direction.
template <class T, class V>
inline Vector<V> color_backward(const Camera<T>& camera, const Vector<V>& in_camera, const Vector<V>& v_colors,
                                const V* sh, int64_t terms, V* sh_out) {
  const ViewColor<V> c = view_color(camera, in_camera, sh, terms);
  const auto in_unit = [](const V& channel) { return channel >= V{} && channel <= T(1); };
  Vector<V> v = {c.raw.x > V{} ? v_colors.x : V{}, c.raw.y > V{} ? v_colors.y : V{}, c.raw.z > V{} ? v_colors.z : V{}};
  if (camera.clamp_colors)
    v = {in_unit(c.raw.x) ? v_colors.x : V{}, in_unit(c.raw.y) ? v_colors.y : V{}, in_unit(c.raw.z) ? v_colors.z : V{}};
  V v_values[16];
  for (int64_t k = 0; k < terms; ++k) {
    v_values[k] = sh[3 * k] * v.x + sh[3 * k + 1] * v.y + sh[3 * k + 2] * v.z;
    sh_out[3 * k] = c.values[k] * v.x, sh_out[3 * k + 1] = c.values[k] * v.y, sh_out[3 * k + 2] = c.values[k] * v.z;
  }
  if (camera.detach_directions) return {V{}, V{}, V{}};
  const Vector<V> v_direction = basis_backward(c.direction, terms, v_values);
  const V along = dot(v_direction, c.direction);
  return camera.rotation * ((1 / c.distance) * (v_direction + -along * c.direction));
}

// All gradients of a register of rows but that of the harmonics' coefficients. `v_color`: of the mean in the camera,
// through the color.
template <class T, class E, class V>
inline RowValues<V> row_backward(const Camera<T>& camera, const RowValues<V>& row, const Projection<E, V>& p,
                                 const ScreenGradient<V>& g, const Vector<V>& v_color) {
  auto v_footprint = footprint_backward(camera, p.footprint, g);
  Vector<V> v_mean = v_color;
  v_mean.z += g.depth;
  if constexpr (E::SHUTTER) {
    V v_u_x, v_u_y;
    read_out_backward(camera, p.motion, p.footprint, v_footprint, v_u_x, v_u_y);
    v_mean = v_mean + p.motion.backward(camera, p.placement, v_u_x, v_u_y);
  }
  PlacementGradient<V> v = p.model.backward(camera, p.placement, v_footprint);
  v.mean = v.mean + v_mean;
  RowValues<V> out;
  place_backward(camera, row, p.placement, v, out);
  out.opacity = g.log_opacity / row.opacity;
  return out;
}

// Typed views of the gradients but those of harmonics.
template <class T>
struct Outputs {
  T *means, *quaternions, *scales, *opacities, *screen;
  explicit Outputs(const RowGradients& g)
      : means(static_cast<T*>(g.means)), quaternions(static_cast<T*>(g.quaternions)),
        scales(static_cast<T*>(g.scales)), opacities(static_cast<T*>(g.opacities)), screen(static_cast<T*>(g.screen)) {}

  void set_zero(int64_t first, int64_t last) const {
    const auto zero = [&](T* values, int64_t width) {
      stream<T>(values + width * first, nullptr, width * (last - first));
    };
    zero(means, 3), zero(quaternions, 4), zero(scales, 3), zero(opacities, 1), zero(screen, 2);
  }
};

// Sums of the slots of rows row(0), row(1), ..., one per lane.
template <class T, class RowAt>
inline Slot<Lanes<T>> sum_slots(const Workspace<T>& ws, RowAt row) {
  constexpr int columns = SLOT_COLUMNS<T>;
  T sums[LANES<T>][columns];
  for (int lane = 0; lane < LANES<T>; ++lane) {
    const T* slots = reinterpret_cast<const T*>(&ws.slots[ws.tiles[row(lane)].first_slot]);
    for (int c = 0; c < columns; ++c) sums[lane][c] = slots[c];
    for (int32_t k = 1; k < ws.tiles[row(lane)].count; ++k)
      for (int c = 0; c < columns; ++c) sums[lane][c] += slots[k * columns + c];
  }
  Slot<Lanes<T>> sum;
  load_columns<T>([&](int lane) { return sums[lane]; }, columns, &sum.s);
  return sum;
}

// A register of visible rows of one table, which may repeat.
template <class E, class T>
void backward_block(const Workspace<T>& ws, const Camera<T>& camera, const Inputs<T>& in, const HarmonicTable<T>& table,
                    const Outputs<T>& out, const int64_t* rows) {
  using V = Lanes<T>;
  const auto row = [&](int lane) { return rows[lane]; };
  Splat<V> splat;
  load_columns<T>([&](int r) { return reinterpret_cast<const T*>(&ws.splats[row(r)]); }, SPLAT_COLUMNS<T>, &splat.x);
  const auto values = load_rows<E>(in, row);
  const Projection<E, V> p(camera, values);
  const ScreenGradient<V> g = screen_gradient(sum_slots(ws, row), splat);
  V sh[3 * 16], v_sh[3 * 16];
  table.load(row, sh);
  const Vector<V> v_color = color_backward(camera, p.placement.mean, g.color, sh, table.terms, v_sh);
  const RowValues<V> v = row_backward(camera, values, p, g, v_color);
  store_columns<T>(&v.mean.x, 3, [&](int r) { return out.means + 3 * row(r); });
  store_columns<T>(v.quaternion, 4, [&](int r) { return out.quaternions + 4 * row(r); });
  store_columns<T>(&v.scales.x, 3, [&](int r) { return out.scales + 3 * row(r); });
  store_columns<T>(&v.opacity, 1, [&](int r) { return out.opacities + row(r); });
  table.store_gradients(v_sh, row);
  store_columns<T>(camera.plain_gradients ? &g.x : &g.abs_x, 2, [&](int r) { return out.screen + 2 * row(r); });
}

// Rows `range` of the input, of one table: culled ones, which neighbor each other, get zeros, the others are gathered until they fill
// a register. In which lane a row is computed does not change its bits.
template <class E, class T>
void backward_range(const Workspace<T>& ws, const Camera<T>& camera, const Inputs<T>& in, const HarmonicTable<T>& table,
                    const Outputs<T>& out, const Range& range) {
  int64_t rows[LANES<T>];
  int count = 0;
  for (int64_t i = range.begin; i < range.end; ++i) {
    if (ws.tiles[i].count == 0) {
      const int64_t first = i;
      while (i + 1 < range.end && ws.tiles[i + 1].count == 0) ++i;
      out.set_zero(first, i + 1), table.zero_gradients(first, i + 1);
      continue;
    }
    rows[count++] = i;
    if (count == LANES<T>) backward_block<E>(ws, camera, in, table, out, rows), count = 0;
  }
  end_stream();
  if (count == 0) return;
  for (int lane = count; lane < LANES<T>; ++lane) rows[lane] = rows[count - 1];
  backward_block<E>(ws, camera, in, table, out, rows);
}

template <class T>
void project_backward(Workspace<T>& ws, const View& view, const Rows& rows, const RowGradients& gradients) {
  const double start = omp_get_wtime();
  const Inputs<T> in(rows);
  const Outputs<T> out(gradients);
  const Camera<T> camera(view);
  with_effects(view, [&](auto effects) {
#pragma omp parallel for num_threads(view.threads) schedule(static)
    for (int64_t part = 0; part < view.threads; ++part)
      for (const HarmonicTable<T>& table : in.harmonics)
        backward_range<decltype(effects)>(ws, camera, in, table, out, table.within({in.count, part, view.threads}));
  });
  ws.seconds[PROJECT_BACKWARD] = omp_get_wtime() - start;
}

}  // namespace SPLAT_VARIANT
