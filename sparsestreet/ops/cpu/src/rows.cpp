// Compiled once per instruction set, with strict IEEE rules.
#include "kernels.h"
#include "projection_backward.hpp"

namespace SPLAT_VARIANT {
namespace {

template <class T>
Workspace<T>& as(void* workspace) { return *static_cast<Workspace<T>*>(workspace); }

template <class T>
RowKernels kernels() {
  return {[]() -> void* { return new Workspace<T>; },
          [](void* w) { delete &as<T>(w); },
          [](void* w) { as<T>(w).poison(); },
          [](void* w) -> const double* { return as<T>(w).seconds; },
          [](void* w) { return as<T>(w).pair_count; },
          [](void* w) { return as<T>(w).samples; },
          [](void* w, const View& v, const Rows& r, void* radii, Report& report) {
            return prepare(as<T>(w), v, r, radii, report);
          },
          [](void* w, const View& v, const Rows& r, const RowGradients& g) { project_backward(as<T>(w), v, r, g); }};
}

}  // namespace

void fill_row_kernels(Kernels& k) { k.rows[0] = kernels<float>(), k.rows[1] = kernels<double>(); }

}  // namespace SPLAT_VARIANT
