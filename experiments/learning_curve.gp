# Median error over the seeds, with its quartiles, against the number of observations.
file = dir . '/learning_curve.csv'
systems = system("awk -F, 'NR > 1 && !seen[$1]++ { print $1 }' '" . file . "'")
set multiplot layout 1, words(systems) margins 0.06, 0.99, 0.12, 0.90 spacing 0.05
set logscale xy
set grid lc rgb '#eeeeee'
set xlabel 'observations'
set key bottom left noenhanced
is(s, m) = strcol('system') eq s && strcol('method') eq m
colour(m) = m eq 'SE' ? 0xd95f02 : m eq 'ICM' ? 0x7570b3 : m eq 'LMC' ? 0x1b9e77 : 0x1f77b4
do for [s in systems] {
  set title s
  if (s eq word(systems, 1)) { set ylabel 'normalised rmse' } else { unset ylabel }
  plot for [m in 'GP2_known_mean0 SE ICM LMC'] file using (is(s, m) ? column('n') : NaN):'rmse_median':'rmse_quartile1':'rmse_quartile3' \
         with yerrorlines lw 2 pt 7 ps 0.6 lc rgb colour(m) title m
}
unset multiplot
