# Distance of trajectories from the true and from the fitted surface over time.
file = dir . '/figS7.csv'
set logscale y
set format y '10^{%L}'
set yrange [1e-17:100]
set grid lc rgb '#eeeeee'
set autoscale xfix
set xlabel 't [s]'
set ylabel 'distance from the surface [m]' noenhanced
set key outside right noenhanced width -8
names = 'analytic_surface_error GP2_est_surface_error GP2_est_fitted_surface_error GP2_est_projected_surface_error GP2_est_projected_fitted_surface_error'
shown(x) = x < 1e-17 ? 1e-17 : x   # 0 has no logarithm
plot for [name in names] file using 't':(shown(column(name))) with lines lw 2 title name
